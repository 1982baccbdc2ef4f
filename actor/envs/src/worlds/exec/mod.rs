//! A world of a user's own, in any language: copies stepped by a process that the actor starts.
//!
//! The process is the command of `--env "exec:COMMAND"`, run by `sh`. What is said to it and what it answers:
//!
//! | who | says | by |
//! | --- | --- | --- |
//! | actor | `{"driml_env": 1, "copies": 16, "seeds": [..]}` | a line to its stdin |
//! | world | `{"driml_env": 1, "copies": 16, "height": 84, "width": 84, "channels": 1, "actions": ["no-op", ..]}` | a line to its stdout |
//! | actor | `{"block": PATH, "bytes": N, "actions": 0, "rewards": 64, "ends": 128, "frames": 192}` | a line to its stdin |
//! | world | the first frames lie in the block | the byte `.` |
//! | actor | the actions lie in the block | the byte `s`, for each step |
//! | world | rewards, ends and the next frames lie there | the byte `.`, for each step |
//!
//! A world that declares `"saves": true` besides is also asked for its state, between two steps:
//!
//! | who | says | by |
//! | --- | --- | --- |
//! | actor | `S` and `{"state": PATH, "bytes_max": M}` | a line to its stdin |
//! | world | the state of all copies is written into the empty file `PATH` | the byte `.` |
//! | | or: this world cannot be saved after all | the byte `-` and a line that says why |
//! | actor | `L` and `{"state": PATH, "bytes_max": M}`: the file holds a state that a world of this command and of as many copies wrote | a line to its stdin |
//! | world | goes on from that state; the frames lie in the block already | the byte `.` |
//!
//! A state is everything that decides what follows, generators included, in at most M bytes of the world's own choice. A state that
//! the world does not take back is a reason to end, with a word to stderr.
//!
//! The end of its stdin tells the process to end. A process that only has to declare itself sees that end after its line: so
//! the shapes are found before the actors start. There are as many `seeds` as copies, each below 2^31; copy i is seeded with
//! the i-th. `PATH` is memory that both share; the numbers are where in it the columns begin, by bytes: `actions` [N] u8,
//! `rewards` [N] f32 of the machine's order, `ends` [N] u8 as [`StepEnd`](crate::StepEnd) numbers them (0 runs on, 1 next
//! level, 2 timed out, 3 terminal) and `frames` [N, H, W, C] u8. The frame after an end is the first of the next episode.
//! What the process writes to stderr is the actor's log.
//!
//! The memory has no name in the file system, and a shell that waits for the actor's end kills the process: when an actor
//! is killed, nothing is left. This side reads and writes the memory as a file, which needs no unsafe code.

mod block;
mod config;
pub(crate) mod error;
mod messages;
mod process;
mod state;
#[cfg(test)]
mod tests;
mod world;

pub use config::{ExecConfig, declaration};
pub use error::ExecError;
pub use world::ExecWorld;
