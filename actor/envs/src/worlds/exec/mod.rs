//! A world of a user's own, in any language: copies stepped by a process that the actor starts.

mod config;
mod declaration;
mod process;
mod protocol;
#[cfg(test)]
mod tests;
mod world;

pub use self::config::ExecConfig;
pub use self::declaration::declaration;
pub use self::world::ExecWorld;
pub use crate::error::ExecError;
