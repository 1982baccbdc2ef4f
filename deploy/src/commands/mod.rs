//! One file per command: its flags, and what the command does with them.

pub(crate) mod actor;
pub(crate) mod completions;
pub(crate) mod doctor;
pub(crate) mod evaluate;
pub(crate) mod inspect;
pub(crate) mod learner;
pub(crate) mod parity;
pub(crate) mod presets;
pub(crate) mod procgen;
pub(crate) mod replay_server;
pub(crate) mod train;
pub(crate) mod watch;

mod join;
