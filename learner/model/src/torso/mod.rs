//! The menu of torsos: each is a file here, a variant of [`TorsoName`], and an arm of each `match` here and of two in the learner, which
//! describe it in checkpoints and set its tolerance in parity cases. `impoola` is `impala` with another last layer.

mod impala;
pub(crate) mod interface;
mod nature;

use std::fmt;

use serde::{Deserialize, Serialize};

use self::{impala::Impala, interface::Torso, nature::Nature};
use crate::error::{ModelError, Result};
use crate::geometry::{ConvLayer, read_size};

/// The torso of a network: `model.torso`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TorsoName {
    /// The convolutions of `conv`. Source: Mnih et al. 2015.
    #[default]
    Nature,
    /// A residual network with a stage for each entry of `channels`. Source: Espeholt et al. 2018.
    Impala,
    /// As `Impala`, but f4 reads the mean of f3 over its locations. Source: Trumpp et al. 2025.
    Impoola,
}

/// The settings of all torsos. Each torso reads its own.
pub(crate) struct TorsoSettings<'a> {
    pub(crate) conv: &'a [ConvLayer],
    pub(crate) channels: &'a [usize],
    pub(crate) scale_blocks: bool,
}

impl TorsoName {
    /// Returns the settings that only other torsos use.
    pub const fn settings_of_others(self) -> &'static [&'static str] {
        match self {
            Self::Nature => &["channels", "scale_blocks"],
            Self::Impala | Self::Impoola => &["conv"],
        }
    }

    /// Builds the torso for an input of (height, width, channels).
    pub(crate) fn build(
        self,
        input: (usize, usize, usize),
        settings: &TorsoSettings<'_>,
    ) -> Box<dyn Torso> {
        match self {
            Self::Nature => Box::new(Nature::new(input, settings.conv)),
            Self::Impala | Self::Impoola => Box::new(Impala {
                input,
                widths: settings.channels.to_vec(),
                scale_blocks: settings.scale_blocks,
                takes_mean: self == Self::Impoola,
            }),
        }
    }

    /// Returns (height, width) of the part of `image` that the torso reads, from the upper left corner. `None` if `conv` does not fit.
    pub fn read_size(self, conv: &[ConvLayer], image: (usize, usize)) -> Option<(usize, usize)> {
        match self {
            Self::Nature => read_size(conv, image),
            // With zero padding, every pixel is in a window.
            Self::Impala | Self::Impoola => Some(image),
        }
    }

    /// Checks that `settings` has what this torso needs and no setting of another torso.
    ///
    /// # Errors
    /// [`ModelError::Config`] names the setting and the torso.
    pub(crate) fn check_settings(self, settings: &TorsoSettings<'_>) -> Result<()> {
        let given = [
            ("conv", !settings.conv.is_empty()),
            ("channels", !settings.channels.is_empty()),
            ("scale_blocks", settings.scale_blocks),
        ];
        let others = self.settings_of_others();
        let (own, way) = match self {
            Self::Nature => ("conv", "model.torso to impala or impoola"),
            Self::Impala | Self::Impoola => ("channels", "model.torso to nature"),
        };
        for (name, is_given) in given {
            if is_given && others.contains(&name) {
                return Err(ModelError::Config(format!(
                    "torso = {self} is made of model.{own}, and model.{name} is given too: leave model.{name} out, or set {way}"
                )));
            }
            if !is_given && name == own {
                return Err(ModelError::Config(format!(
                    "{own} is empty, and torso = {self} is made of it: set model.{own}, or set {way}"
                )));
            }
        }
        Ok(())
    }
}

impl fmt::Display for TorsoName {
    /// Writes the name that settings use.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}
