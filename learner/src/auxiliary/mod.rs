//! The menu of auxiliary losses: what an agent learns beside the return.
//!
//! Each loss is a file of this folder that implements [`AuxiliaryLoss`], and a line of [`MENU`]. An update does not depend on which
//! loss it computes: the loss itself defines its heads, its positives and the names under which it is reported. A program that uses
//! this crate adds a loss with [`register`], without a change here.

pub mod cpc;
pub mod curl;
pub mod dim;
pub mod loss;
pub mod none;
pub mod positives;
pub mod settings;

use std::{fmt, sync::OnceLock};

use loss::{AuxiliaryLoss, MenuItem};
use positives::Positives;
use serde::{Deserialize, Serialize};
use settings::AuxiliarySettings;

use crate::error::{Result, UpdateError};

/// All auxiliary losses of this crate; a new one adds a line here.
pub const MENU: &[&MenuItem] = &[&none::NONE, &dim::DIM, &cpc::CPC, &curl::CURL];

/// The losses that the program registered.
static CUSTOM: OnceLock<Vec<&'static MenuItem>> = OnceLock::new();

/// Adds losses to the menu; a program calls this first. `learner.update.auxiliary_loss` accepts their names from then on.
///
/// # Panics
/// If the function was called before, or two losses of the menu would have the same name.
pub fn register(items: Vec<&'static MenuItem>) {
    for (index, MenuItem { name, .. }) in items.iter().enumerate() {
        let is_known = |known: &&MenuItem| known.name == *name;
        assert!(
            !MENU.iter().chain(&items[..index]).any(is_known),
            "two auxiliary losses are named {name}: choose another name"
        );
    }
    let first = CUSTOM.set(items);
    first.expect("a program registers its losses once");
}

/// All items: the menu and the registered losses.
fn all_items() -> impl Iterator<Item = &'static MenuItem> {
    MENU.iter()
        .chain(CUSTOM.get().into_iter().flatten())
        .copied()
}

/// The auxiliary loss of an agent, from the [`MENU`] or [`register`]ed. Settings refer to it by its name.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(try_from = "String", into = "&'static str")]
pub struct AuxiliaryKind(&'static MenuItem);

impl AuxiliaryKind {
    /// No auxiliary loss: the agent learns the return alone.
    pub const NONE: Self = Self(&none::NONE);

    /// The auxiliary loss of this item of the menu.
    pub const fn from_item(item: &'static MenuItem) -> Self {
        Self(item)
    }

    /// The loss's name in settings, such as `dim`.
    pub const fn name(self) -> &'static str {
        self.0.name
    }

    /// What the loss compares s_t with.
    pub const fn positives(self) -> Positives {
        self.0.positives
    }

    /// The names of all losses that may be reported, in order.
    pub const fn loss_names(self) -> &'static [&'static str] {
        self.0.loss_names
    }

    /// Creates the loss from settings.
    pub fn make_loss(self, settings: &AuxiliarySettings<'_>) -> Result<Box<dyn AuxiliaryLoss>> {
        let loss = (self.0.make)(settings)?;
        match settings.own.keys().find(|other| *other != self.name()) {
            Some(other) => Err(UpdateError::AuxiliaryLoss(format!(
                "auxiliary_loss = {} has no use for the table {other}: take the table {other} out of learner.update, or take the agent {other}",
                self.name()
            ))),
            None => Ok(loss),
        }
    }
}

impl PartialEq for AuxiliaryKind {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for AuxiliaryKind {}

impl fmt::Debug for AuxiliaryKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl TryFrom<String> for AuxiliaryKind {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        let item = all_items().find(|item| item.name == name);
        item.map(Self).ok_or_else(|| {
            let known: Vec<_> = all_items().map(|item| format!("`{}`", item.name)).collect();
            let known = known.join(", ");
            format!("unknown variant `{name}`, expected one of {known}")
        })
    }
}

impl From<AuxiliaryKind> for &'static str {
    fn from(auxiliary_loss: AuxiliaryKind) -> Self {
        auxiliary_loss.name()
    }
}

#[cfg(test)]
mod tests {
    use super::{MenuItem, dim::DIM, register};

    #[test]
    #[should_panic(expected = "two auxiliary losses are named dim: choose another name")]
    fn a_name_of_the_menu_cannot_be_registered() {
        register(vec![&DIM]);
    }

    #[test]
    #[should_panic(expected = "two auxiliary losses are named own: choose another name")]
    fn a_name_cannot_be_registered_twice() {
        const OWN: MenuItem = MenuItem { name: "own", ..DIM };
        register(vec![&OWN, &OWN]);
    }
}
