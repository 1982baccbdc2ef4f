//! The hardware of this machine, cores, memory and devices, and what it lacks for a run.
//!
//! Start with [`resources::Machine`] for the sizes of a run, with [`doctor::examine`] for what is missing, and with
//! [`device::check_device`] before computing on a device. This crate starts no run and reads no settings. The program exits with
//! code 64 on an [`error::Usage`].
//!
//! ```
//! use driml_machine::{resources::Machine, units::gib};
//!
//! let machine = Machine::detect();
//! println!("{} cores, {} of memory free", machine.cores, gib(machine.memory_bytes));
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

pub mod device;
pub mod doctor;
pub mod error;
pub mod limits;
pub mod process_env;
pub mod resources;
pub mod shell;
pub mod speed_meter;
pub mod units;
pub mod whole_number;
