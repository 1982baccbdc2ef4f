//! The menu of auxiliary losses: what an agent learns beside the return.
//!
//! Each loss is a file of this folder that implements [`AuxiliaryLoss`], and a line of [`MENU`]. Nothing
//! outside this folder asks which loss it is: what the rest must know (heads, positives, names of what is reported) the
//! loss defines itself. Your own program [`register`]s one without a change here.

pub mod cpc;
pub mod curl;
pub mod dim;
pub mod key_encoder;
pub mod loss;
pub mod none;
pub mod positives;
pub mod settings;

use std::{
    fmt,
    str::FromStr,
    sync::{Mutex, PoisonError},
};

use loss::{AuxiliaryLoss, MenuItem};
use positives::Positives;
use serde::{Deserialize, Serialize};
use settings::AuxiliarySettings;

use crate::error::UpdateError;

/// Every auxiliary loss; a new one gets its line here.
pub const MENU: &[&MenuItem] = &[&none::NONE, &dim::DIM, &cpc::CPC, &curl::CURL];

/// Those that the program added.
static OWN: Mutex<Vec<&'static MenuItem>> = Mutex::new(Vec::new());

/// Adds a loss to the menu, before anything else is done: `learner.update.objective` takes its name from then on. A name that is
/// in the menu already keeps its loss.
pub fn register(item: &'static MenuItem) {
    let mut own = OWN.lock().unwrap_or_else(PoisonError::into_inner);
    own.push(item);
}

/// The menu, with what the program added.
fn all() -> Vec<&'static MenuItem> {
    let own = OWN.lock().unwrap_or_else(PoisonError::into_inner);
    MENU.iter().chain(own.iter()).copied().collect()
}

/// The auxiliary loss of an agent: an item of the [`MENU`] or one that was [`register`]ed, by its name in settings.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(try_from = "String", into = "&'static str")]
pub struct Objective(&'static MenuItem);

impl Objective {
    /// No auxiliary loss: the agent learns the return alone.
    pub const NONE: Self = Self(&none::NONE);

    /// The objective of this item of the menu.
    pub const fn of(item: &'static MenuItem) -> Self {
        Self(item)
    }

    /// Its name in settings, such as `dim`.
    pub const fn name(self) -> &'static str {
        self.0.name
    }

    /// What the loss compares s_t with.
    pub const fn positives(self) -> Positives {
        self.0.positives
    }

    /// The names of all losses that may be reported, in order.
    pub const fn losses(self) -> &'static [&'static str] {
        self.0.losses
    }

    /// Makes the loss from settings.
    pub fn loss(
        self,
        settings: &AuxiliarySettings<'_>,
    ) -> Result<Box<dyn AuxiliaryLoss>, UpdateError> {
        let loss = (self.0.make)(settings)?;
        match settings.own.keys().find(|other| *other != self.name()) {
            Some(other) => Err(UpdateError::Objective(format!(
                "objective = {} has no use for the table {other}: take the table {other} out of learner.update, or take the agent {other}",
                self.name()
            ))),
            None => Ok(loss),
        }
    }
}

impl PartialEq for Objective {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for Objective {}

impl fmt::Debug for Objective {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Objective {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let all = all();
        let item = all.iter().copied().find(|item| item.name == name);
        item.map(Self).ok_or_else(|| {
            let known: Vec<_> = all.iter().map(|item| format!("`{}`", item.name)).collect();
            format!(
                "unknown variant `{name}`, expected one of {}",
                known.join(", ")
            )
        })
    }
}

impl TryFrom<String> for Objective {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        name.parse()
    }
}

impl From<Objective> for &'static str {
    fn from(objective: Objective) -> Self {
        objective.name()
    }
}
