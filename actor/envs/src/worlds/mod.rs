//! The menu of worlds: each is a file or folder here, and a line of `worlds!`.
//! A program adds worlds without a change here; `plugin` has those.

pub(crate) mod chain;
pub(crate) mod exec;
pub(crate) mod ising;
pub(crate) mod pacman;
pub(crate) mod procgen;

use serde::Serialize;
use toml::Table;

use crate::plugin::CustomWorld;
use crate::settings::{Variants, WorldSettings};

/// Makes [`WorldConfig`] and the list of kinds from one line per world.
macro_rules! worlds {
    ($($(#[$doc:meta])* $kind:literal $World:ident($Settings:ty);)+) => {
        /// The settings of one world; `kind` in the file says which world.
        #[derive(Clone, Debug, PartialEq, Serialize)]
        #[serde(tag = "kind")]
        pub enum WorldConfig {
            $($(#[$doc])* #[serde(rename = $kind)] $World($Settings),)+
            /// A world that the program registered.
            #[serde(untagged)]
            Custom(CustomWorld),
        }

        /// The `kind` of each world of this crate in a settings file.
        pub(crate) const KIND_NAMES: &[&str] = &[$($kind),+];

        /// Every world of this crate: its kind, and a function that returns its variants.
        pub(crate) const KINDS: &[(&str, fn() -> Variants)] = &[$(($kind, <$Settings>::variants)),+];

        impl WorldConfig {
            pub(crate) fn settings(&self) -> (&'static str, &(dyn WorldSettings + 'static)) {
                match self {
                    $(Self::$World(settings) => ($kind, settings),)+
                    Self::Custom(custom) => (custom.kind(), custom.settings()),
                }
            }

            /// Reads the settings of this crate's world `kind`; `None` if the crate has no such world.
            pub(crate) fn parse_built_in(
                kind: &str,
                fields: &Table,
            ) -> Option<Result<Self, toml::de::Error>> {
                match kind {
                    $($kind => Some(fields.clone().try_into().map(Self::$World)),)+
                    _ => None,
                }
            }
        }
    };
}

worlds! {
    /// One of Procgen's games.
    "procgen" Procgen(procgen::ProcgenConfig);
    /// Ms. PacMan.
    "mspacman" MsPacman(pacman::PacmanConfig);
    /// The Ising patch in noise.
    "ising" Ising(ising::IsingConfig);
    /// A corridor with a small reward at one end and a large one at the other.
    "chain" Chain(chain::ChainConfig);
    /// A process that a command starts.
    "exec" Exec(exec::ExecConfig);
}
