//! What can be wrong with a world that is a process of its own, in a sentence each.

use std::fmt;
use std::io;
use std::time::Duration;

/// Why a world's process cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("the world `{command}` {fault}{words}")]
pub struct ExecError {
    /// The command, as `--env` has it after `exec:`.
    pub command: String,
    /// What is wrong.
    pub fault: Fault,
    /// The last lines that it wrote to stderr.
    pub words: LastWords,
}

/// What is wrong with a world's process.
#[derive(Debug, thiserror::Error)]
pub enum Fault {
    /// The operating system refused something.
    #[error("cannot be used: {doing}: {source}")]
    System {
        /// What was being done.
        doing: &'static str,
        /// What the system said.
        source: io::Error,
    },
    /// It ended by itself.
    #[error("ended {doing} ({how})")]
    Ended {
        /// In the middle of what.
        doing: &'static str,
        /// How, such as its exit status.
        how: String,
    },
    /// It closed its stdout and goes on.
    #[error("closed its stdout {doing} without ending, and was killed")]
    Closed {
        /// In the middle of what.
        doing: &'static str,
    },
    /// It took too long.
    #[error("has not answered for {} s {doing}, and was killed: if it needs longer, --set {setting}=N", limit.as_secs_f64())]
    Silent {
        /// In the middle of what.
        doing: &'static str,
        /// How long it was waited for.
        limit: Duration,
        /// The setting that says how long.
        setting: &'static str,
    },
    /// What it wrote is no declaration of a world.
    #[error(
        "does not declare itself as a world: its first line on stdout is {line:?} and not JSON with \"driml_env\" and the shapes ({why}); \
         deploy/python/driml_env.py makes a Gymnasium environment such a world"
    )]
    NoWorld {
        /// Its first line, or the beginning of it.
        line: String,
        /// What is missing.
        why: String,
    },
    /// It speaks another version of the protocol.
    #[error(
        "speaks version {found} of the protocol, and this driml speaks version {known}: take the driml_env.py that came with it"
    )]
    Version {
        /// Its version.
        found: u64,
        /// Ours.
        known: u64,
    },
    /// It is another world than the run's settings say.
    #[error(
        "declares {found}, but the run's settings say {promised}: start the run anew, or the command as it was"
    )]
    OtherShape {
        /// What it declares.
        found: String,
        /// What the settings say.
        promised: String,
    },
    /// It has not as many copies as were asked for.
    #[error(
        "has {found} copies where {asked} were asked for: it has to make as many as \"copies\" says"
    )]
    OtherCopies {
        /// Its copies.
        found: usize,
        /// Those asked for.
        asked: usize,
    },
    /// It said something else than the byte that it was to answer with.
    #[error(
        "answered {doing} with the byte {byte:#04x} and not with `.`: does it print to stdout? That belongs to the protocol"
    )]
    OtherByte {
        /// In the middle of what.
        doing: &'static str,
        /// What it said.
        byte: u8,
    },
    /// A reward that is no number.
    #[error("gave copy {copy} the reward {reward}")]
    Reward {
        /// Which copy, counted from 0.
        copy: usize,
        /// The reward.
        reward: f32,
    },
    /// An end that does not exist.
    #[error(
        "ended the step of copy {copy} with {end}; 0 runs on, 1 is the next level, 2 timed out, 3 terminal"
    )]
    End {
        /// Which copy, counted from 0.
        copy: usize,
        /// The number.
        end: u8,
    },
    /// It offers to save its state, and found that it cannot.
    #[error("cannot save its state: {why}")]
    NotSaved {
        /// Why, in its own words.
        why: String,
    },
    /// It said that its state is saved and wrote none.
    #[error(
        "wrote no state: where it says `.` in the middle of saving its state, the bytes have to lie in \"state\""
    )]
    NoState,
    /// Its state is too long.
    #[error("wrote a state of {bytes} bytes; {max} are possible for all its copies together")]
    StateTooLarge {
        /// Its length, of all copies together.
        bytes: u64,
        /// The longest possible.
        max: u64,
    },
}

/// The last lines of a process that failed; nothing if it wrote none.
#[derive(Debug, Default)]
pub struct LastWords(pub(super) Vec<String>);

impl fmt::Display for LastWords {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() {
            return Ok(());
        }
        write!(f, ". Its last words:\n  {}", self.0.join("\n  "))
    }
}
