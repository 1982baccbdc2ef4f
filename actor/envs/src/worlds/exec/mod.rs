//! A world of a user's own, in any language: copies stepped by a process that the actor starts.

mod process;
mod protocol;
#[cfg(test)]
pub(crate) mod tests;
mod world;

pub use self::protocol::ExecConfig;
pub use self::world::{ExecWorld, declaration};
