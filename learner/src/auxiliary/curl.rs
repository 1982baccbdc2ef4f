//! CURL: InfoNCE between two views of the same state, the second one encoded by a slow copy of the network.
//! It makes no view (`augment` does) and does not move the copy: that is the target network, which keeps C51's pace.
//!
//! The query is psi_4(f4) of the online network, the key psi_4(f4) of the target network, which for this agent keeps a copy
//! of that head too. No gradient reaches the key. Source: Srinivas et al. 2020 and He et al. 2020 for the two views and the
//! momentum encoder; Mazoure et al. 2020, appendix: "exactly the same networks for measuring similarity (i.e. one residual
//! block for CURL and CPC)", "with EMA on the target network", hence no bilinear product and no second head.

use candle_core::Tensor;
use driml_model::{DimParts, Features, Network};

use super::dim::{self, Dots};
use crate::{
    loss::info_nce::{Scores, info_nce_loss},
    update::UpdateError,
};

/// The one head; the target network has its copy.
pub const HEADS: DimParts = DimParts {
    psi3: false,
    phi3: false,
    psi4: true,
    phi4: false,
    action: false,
};

/// The CURL objective's settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Curl {
    /// Bound c of the scores' soft clip `c * tanh(x / c)`.
    pub tanh_clip: f64,
}

impl Curl {
    /// The loss, a scalar, before its weight, in the place of the pair 4t4.
    ///
    /// `query` are the online network's features of one view, `key` the target network's of the other; `action` [B] gives
    /// the rows, all of which take part: a state needs no successor here.
    ///
    /// # Errors
    /// A network without the head.
    pub fn losses(
        &self,
        (online, query): (&Network, &Features),
        (target, key): (&Network, &Features),
        action: &Tensor,
    ) -> Result<[Option<Tensor>; 4], UpdateError> {
        let query = online.psi4(&query.f4, action)?;
        let key = target.psi4(&key.f4.detach(), action)?.detach();
        let Dots { dots, rkhs } = dim::global_dots(&query, &key)?;
        let scores = Scores::new(rkhs, self.tanh_clip);
        let all = vec![1; action.elem_count()];
        let loss = info_nce_loss(&dots, &all, scores, online.operations())?;
        Ok([None, None, None, Some(loss)])
    }
}
