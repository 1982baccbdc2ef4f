//! The settings of a world in its own process, the protocol between process and actor, and the memory that they share.
//! It checks what the process sends; `process` starts and ends the process.
//!
//! The process is the command of `--env "exec:COMMAND"`, run by `sh`. Requests and answers:
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
//! If the declaration also has `"saves": true`, the actor asks for the state between two steps:
//!
//! | who | says | by |
//! | --- | --- | --- |
//! | actor | `S` and `{"state": PATH, "bytes_max": M}` | a line to its stdin |
//! | world | the state of all copies is written into the empty file `PATH` | the byte `.` |
//! | | or: this world cannot be saved after all | the byte `-` and a line that says why |
//! | actor | `L` and `{"state": PATH, "bytes_max": M}`: the file holds a state that a world of this command and of as many copies wrote | a line to its stdin |
//! | world | continues from that state; the frames lie in the block already | the byte `.` |
//!
//! A state holds everything that determines the future, including generators, in at most M bytes of a format that the
//! world chooses. A world that cannot load a state ends, with a message on stderr.
//!
//! The process must end when its stdin closes. Before the actors start, a process is asked for its declaration alone, to find the
//! shapes: its stdin closes after that line. There are as many `seeds` as copies, each below 2^31; copy i is seeded with
//! the i-th. `PATH` is the shared memory, and the numbers are the byte offsets of its columns: `actions` [N] u8,
//! `rewards` [N] f32 in the machine's byte order, `ends` [N] u8 as [`StepEnd`](crate::StepEnd) numbers them (0 runs on, 1 next
//! level, 2 timed out, 3 terminal) and `frames` [N, H, W, C] u8. The frame after an end is the first of the next episode.
//! The actor logs the process's stderr, up to 50 lines per second.
//!
//! The memory has no name in the file system, and a guard shell kills the process when the actor ends: a killed actor
//! leaves nothing behind. The actor reads and writes the memory as a file, which needs no unsafe code.

use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::FileExt;

use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::environment::FrameShape;
use crate::error::EnvError;
use crate::saved;
use crate::settings::WorldSettings;

/// A command, and the world that the command declared when the run was made. Each actor checks that its own process declares the same.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExecConfig {
    /// The command, which `sh` runs in the actor's working directory.
    pub command: String,
    /// Rows of a frame, as declared.
    pub height: usize,
    /// Columns of a frame, as declared.
    pub width: usize,
    /// Bytes per pixel, as declared: 1 is grey, 3 are colours.
    pub channels: usize,
    /// The names of the actions, as declared.
    pub actions: Vec<String>,
    /// Time-out of the declaration, of the first frames and of loading a state, in milliseconds; then the process is killed.
    pub start_timeout_ms: u64,
    /// Time-out of a step of all copies and of saving their state, in milliseconds; then the process is killed.
    pub step_timeout_ms: u64,
}

impl ExecConfig {
    /// Describes the declared frames and actions.
    pub(super) fn describe(&self) -> String {
        format!(
            "frames of {} x {} x {} and the {} actions {}",
            self.height,
            self.width,
            self.channels,
            self.actions.len(),
            self.actions.join(", ")
        )
    }
}

/// The protocol's version. A process that speaks another version is rejected.
pub(super) const VERSION: u64 = 1;

/// The most characters of a line that a message quotes.
const QUOTED_CHARS_MAX: usize = 200;

/// The declaration of a world: its copies, shapes and actions.
#[derive(Debug, Deserialize)]
pub(super) struct Declaration {
    pub(super) copies: usize,
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) channels: usize,
    pub(super) actions: Vec<String>,
    /// Whether the world can save and load its state. Worlds of earlier versions lack this field.
    #[serde(default)]
    pub(super) saves: bool,
}

impl Declaration {
    pub(super) fn parse(line: &[u8]) -> Result<Self, String> {
        let not_a_world = |why: String| {
            let line = String::from_utf8_lossy(line);
            let line: String = line.chars().take(QUOTED_CHARS_MAX).collect();
            format!(
                "does not declare itself as a world: its first line on stdout is {line:?} and not JSON with \"driml_env\" and the shapes ({why}); \
                 deploy/python/driml_env.py makes a Gymnasium environment such a world"
            )
        };
        let value: Value = serde_json::from_slice(line).map_err(|e| not_a_world(e.to_string()))?;
        let found = value.get("driml_env").and_then(Value::as_u64);
        match found {
            Some(VERSION) => serde_json::from_value(value).map_err(|e| not_a_world(e.to_string())),
            Some(found) => Err(format!(
                "speaks version {found} of the protocol, and this driml speaks version {VERSION}: take the driml_env.py that came with it"
            )),
            None => Err(not_a_world("\"driml_env\" is missing".into())),
        }
    }

    /// Returns `config` with the declared shapes and actions.
    pub(super) fn applied_to(self, config: &ExecConfig) -> ExecConfig {
        ExecConfig {
            height: self.height,
            width: self.width,
            channels: self.channels,
            actions: self.actions,
            ..config.clone()
        }
    }
}

/// Each column begins at a multiple of this many bytes, so that no two columns share a cache line.
const ALIGNMENT: usize = 64;

/// The offset of each column and the length of the whole memory, in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
struct Layout {
    bytes: usize,
    actions: usize,
    rewards: usize,
    ends: usize,
    frames: usize,
}

impl Layout {
    const fn new(copies: usize, shape: FrameShape) -> Self {
        let rewards = copies.next_multiple_of(ALIGNMENT);
        let ends = (rewards + copies * size_of::<f32>()).next_multiple_of(ALIGNMENT);
        let frames = (ends + copies).next_multiple_of(ALIGNMENT);
        Self {
            bytes: frames + copies * shape.bytes(),
            actions: 0,
            rewards,
            ends,
            frames,
        }
    }
}

/// The shared memory. It has no name in the file system, and is freed once both processes have closed it.
pub(super) struct Block {
    file: File,
    layout: Layout,
    /// Rewards, padding and ends: a reused buffer.
    results: Vec<u8>,
}

impl Block {
    /// Creates the memory and seals its size.
    pub(super) fn new(copies: usize, shape: FrameShape) -> io::Result<Self> {
        let layout = Layout::new(copies, shape);
        let flags = MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING;
        let file = File::from(memfd_create(c"driml-world", flags)?);
        file.set_len(layout.bytes as u64)?;
        let seals = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW | SealFlag::F_SEAL_SEAL;
        fcntl(&file, FcntlArg::F_ADD_SEALS(seals))?;
        Ok(Self {
            file,
            layout,
            results: vec![0; layout.ends + copies - layout.rewards],
        })
    }

    /// The message that says where the memory is, and its layout.
    pub(super) fn open_message(&self) -> Value {
        let mut message = json!(self.layout);
        message["block"] = fd_path(&self.file).into();
        message
    }

    /// Writes the actions [N].
    pub(super) fn write_actions(&self, actions: &[u8]) -> io::Result<()> {
        self.file.write_all_at(actions, self.layout.actions as u64)
    }

    /// Reads rewards [N] and the numbers of ends [N].
    pub(super) fn read_results(&mut self, rewards: &mut [f32]) -> io::Result<&[u8]> {
        let (first, ends) = (self.layout.rewards, self.layout.ends);
        self.file.read_exact_at(&mut self.results, first as u64)?;
        let (numbers, ends) = self.results.split_at(ends - first);
        let numbers = numbers.chunks_exact(size_of::<f32>());
        for (reward, bytes) in rewards.iter_mut().zip(numbers) {
            *reward = f32::from_ne_bytes(bytes.try_into().expect("four bytes"));
        }
        Ok(ends)
    }

    /// Reads the frames [N, H, W, C].
    pub(super) fn read_frames(&self, frames: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(frames, self.layout.frames as u64)
    }

    /// Writes the frames [N, H, W, C], as the process does after a step.
    pub(super) fn write_frames(&self, frames: &[u8]) -> io::Result<()> {
        self.file.write_all_at(frames, self.layout.frames as u64)
    }
}

/// Creates memory that holds exactly `state`. It is freed once the file is closed.
pub(super) fn state_file(state: &[u8]) -> io::Result<File> {
    let file = File::from(memfd_create(c"driml-world-state", MFdFlags::MFD_CLOEXEC)?);
    file.write_all_at(state, 0)?;
    Ok(file)
}

/// The path by which another process of the same user opens a file without a name, as long as this process lives.
pub(super) fn fd_path(file: &File) -> String {
    format!("/proc/{}/fd/{}", std::process::id(), file.as_raw_fd())
}

/// Longest state that a process may give for all its copies together, bytes.
pub(super) const WORLD_STATE_BYTES_MAX: u64 = 64 << 20;

/// A saved state of a world, with the settings that identify the world.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ExecState {
    pub(super) config: ExecConfig,
    pub(super) copies: usize,
    /// The frames in which the next actions are taken [N, H, W, C].
    pub(super) frames: Vec<u8>,
    pub(super) state: Vec<u8>,
}

impl ExecState {
    pub(super) fn from_bytes(
        bytes: &[u8],
        config: &ExecConfig,
        num_envs: usize,
    ) -> Result<Self, EnvError> {
        let this: Self = saved::decode(bytes)?;
        let found = &this.config;
        if found.command != config.command {
            return Err(EnvError::State(format!(
                "it is of the world `{}`, and this is `{}`: give the command as it was",
                found.command, config.command
            )));
        }
        saved::check_env_count(this.copies, num_envs)?;
        saved::ensure_fits(
            found.frame_shape() == config.frame_shape() && found.actions == config.actions,
            "the shape of its frames or its actions",
        )?;
        let frame_bytes = num_envs * config.frame_shape().bytes();
        saved::ensure_fits(this.frames.len() == frame_bytes, "the number of its frames")?;
        Ok(this)
    }
}
