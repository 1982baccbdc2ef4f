//! What this machine offers and lacks: cores, memory, devices.
//!
//! Start with [`resources::Machine`] for what sizes a run, with [`doctor::examine`] for what is missing, and with
//! [`device::ready_for`] before anything is computed on a device. It starts no run and knows no setting. The errors that the
//! program answers with exit code 64 are [`error::Usage`].
//!
//! ```
//! use driml_machine::{resources::Machine, units::gib};
//!
//! let machine = Machine::this();
//! println!("{} cores, {} of memory free", machine.cores, gib(machine.memory_bytes));
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod device;
pub mod doctor;
pub mod effort;
pub mod error;
pub mod limits;
pub mod process_env;
pub mod resources;
pub mod shell;
pub mod units;
pub mod whole_number;
