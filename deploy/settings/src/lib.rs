//! The settings of a run: presets in layers, flags over them, what the machine decides, and what follows from the rest.
//!
//! Start with [`flags::resolve`], which makes a [`config::RunConfig`] of a command line, or [`flags::of_names`], which makes one of
//! names. `presets/*.toml` has every number, each with its source.
//!
//! ```
//! use driml_machine::resources::Machine;
//! use driml_settings::flags::of_names;
//!
//! let sets = ["replay.transitions_max=200000", "learner.update.adam.lr=1e-4"];
//! let config = of_names("paper", "procgen:bigfish", "driml-ada", &sets, &Machine::this())?;
//! assert_eq!(config.run.world, "procgen:bigfish");
//! assert_eq!(config.frames(), 200_000);
//! # Ok::<(), driml_machine::error::Usage>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod config;
mod derived;
pub mod flags;
pub mod memory;
pub mod menu;
mod overrides;
pub mod presets;

pub use overrides::leaves;
