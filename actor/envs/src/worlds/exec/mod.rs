//! A world that a user writes, in any language: the actor starts a process that steps all copies (environments).

mod process;
mod protocol;
#[cfg(test)]
pub(crate) mod tests;
mod world;

pub use self::protocol::ExecConfig;
pub use self::world::{ExecWorld, probe_command};
