//! The settings of a run: layers of presets, flags over them, values that depend on the machine, and values derived from others.
//!
//! Start with [`flags::resolve`], which makes a [`config::RunConfig`] from a command line, or [`flags::resolve_names`], which makes one
//! from names. `presets/*.toml` has every number with its source.
//!
//! ```
//! use driml_machine::resources::Machine;
//! use driml_settings::flags::resolve_names;
//!
//! let sets = ["replay.transitions_max=200000", "learner.update.adam.lr=1e-4"];
//! let config = resolve_names("paper", "procgen:bigfish", "driml-ada", &sets, &Machine::detect())?;
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
