//! Implements the world traits with a process that steps copies of a game: each step sends it one byte and reads one byte back.
//! `protocol` defines the messages. `probe_command` asks a command what world it is.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::time::Duration;

use rand::Rng;
use serde_json::json;
use tracing::Level;

use super::process::{Exchange, WorldProcess};
use super::protocol::{
    Block, Declaration, ExecConfig, ExecState, VERSION, WORLD_STATE_BYTES_MAX, fd_path, state_file,
};
use crate::environment::{Environment, FrameShape, StepEnd, StepResult};
use crate::envs::{RngUse, check_frames, check_num_envs, check_step, env_rng};
use crate::error::{EnvError, require};
use crate::saved;
use crate::settings::{BuildResult, Variants, WorldSettings};

/// Longest side of a frame, in pixels.
const SIDE_MAX: usize = 4096;

/// The most bytes per pixel.
const CHANNELS_MAX: usize = 16;

/// Most actions of a world: the wire numbers them with a byte.
const ACTIONS_MAX: usize = 255;

/// Longest time limit, in milliseconds: a day.
const TIMEOUT_MS_MAX: u64 = 86_400_000;

/// Request for a step: the actions lie in the block.
const STEP: &str = "s";

/// Reply of success: the block has the frames, and after a step rewards and ends; or a state is saved, or loaded.
const DONE: u8 = b'.';

/// Request to save the state.
const SAVE: &str = "S";

/// Request to load a state.
const LOAD: &str = "L";

/// Reply that the state cannot be saved; a line with the reason follows.
const NOT_SAVED: u8 = b'-';

/// Copies of one game, stepped by one separate process.
pub struct ExecWorld {
    process: WorldProcess,
    block: Block,
    config: ExecConfig,
    num_envs: usize,
    can_save: bool,
}

impl ExecWorld {
    /// Starts the process and waits for the first frames.
    ///
    /// # Errors
    /// A command that cannot be started, another world than `config` says, or one that takes too long.
    pub fn new(config: &ExecConfig, num_envs: usize, seed: u64) -> Result<Self, EnvError> {
        config.validate()?;
        check_num_envs(num_envs)?;
        let (mut process, declared) = start_process(config, &seeds(seed, num_envs), Level::INFO)?;
        let (copies, can_save) = (declared.copies, declared.saves);
        let found = declared.applied_to(config);
        if found != *config {
            return Err(process.error(&format!(
                "declares {}, but the run's settings say {}: start a new run, or use the run's command",
                found.describe(),
                config.describe()
            )));
        }
        if copies != num_envs {
            return Err(process.error(&format!(
                "has {copies} copies, and {num_envs} were requested: it must make as many as \"copies\" says"
            )));
        }
        process.exchange = config.start_wait("making the memory that it shares");
        let block = Block::new(num_envs, config.frame_shape());
        let block = block.map_err(|e| process.io_error(&e))?;
        process.exchange = config.start_wait("before its first frames");
        process.write(&format!("{}\n", block.open_message()))?;
        let mut world = Self {
            process,
            block,
            config: config.clone(),
            num_envs,
            can_save,
        };
        world.expect_done()?;
        Ok(world)
    }

    fn expect_done(&mut self) -> Result<(), EnvError> {
        match self.process.read_byte()? {
            DONE => Ok(()),
            byte => Err(self.unexpected_byte(byte)),
        }
    }

    fn unexpected_byte(&self, byte: u8) -> EnvError {
        let doing = self.process.exchange.doing;
        self.process.error(&format!(
            "answered {doing} with the byte {byte:#04x} and not with `.`: does it print to stdout? That belongs to the protocol"
        ))
    }

    /// Sends the request `request`, to save or load a state, with the path of its memory.
    fn request_state(&mut self, request: &str, memory: &File) -> Result<(), EnvError> {
        let place = json!({"state": fd_path(memory), "bytes_max": WORLD_STATE_BYTES_MAX});
        self.process.request(&format!("{request}{place}\n"))
    }

    /// Returns the state of the process's copies, in the process's format.
    fn save_process(&mut self) -> Result<Vec<u8>, EnvError> {
        self.process.exchange = self.config.step_wait("in the middle of saving its state");
        let memory = state_file(&[]).map_err(|e| self.process.io_error(&e))?;
        self.request_state(SAVE, &memory)?;
        match self.process.read_byte()? {
            DONE => {}
            NOT_SAVED => {
                let line = self.process.read_line()?;
                let why = String::from_utf8_lossy(&line);
                // The process continues: its reply is complete.
                let (command, why) = (&self.config.command, why.trim());
                let text = format!("the world `{command}` cannot save its state: {why}");
                return Err(EnvError::NotSaved(text));
            }
            byte => return Err(self.unexpected_byte(byte)),
        }
        let written = memory.metadata().map_err(|e| self.process.io_error(&e))?;
        let bytes = written.len();
        if bytes == 0 {
            return Err(self.process.error(&format!(
                "wrote no state: before it answers `.` {}, it must write the bytes to \"state\"",
                self.process.exchange.doing
            )));
        }
        if bytes > WORLD_STATE_BYTES_MAX {
            return Err(self.process.error(&format!(
                "wrote a state of {bytes} bytes; {WORLD_STATE_BYTES_MAX} are possible for all its copies together"
            )));
        }
        let mut state = vec![0; bytes as usize];
        let read = memory.read_exact_at(&mut state, 0);
        read.map_err(|e| self.process.io_error(&e))?;
        Ok(state)
    }
}

/// Starts a world's process, asks it for a copy for each of `seeds`, and reads its declaration. Its stderr is logged at `level`.
fn start_process(
    config: &ExecConfig,
    seeds: &[u32],
    level: Level,
) -> Result<(WorldProcess, Declaration), EnvError> {
    let command = &config.command;
    let exchange = config.start_wait("before it declared itself");
    let process = WorldProcess::start(command, exchange, level);
    let mut process = process.map_err(|e| {
        let text = format!("the world `{command}` cannot be used: starting it: {e}");
        EnvError::Exec(text)
    })?;
    let request = json!({"driml_env": VERSION, "copies": seeds.len(), "seeds": seeds});
    process.write(&format!("{request}\n"))?;
    let line = process.read_line()?;
    let declaration = Declaration::parse(&line).map_err(|why| process.error(&why))?;
    Ok((process, declaration))
}

impl ExecConfig {
    /// An exchange with the start's time-out: the process declares itself, makes its first frames or loads a state.
    const fn start_wait(&self, doing: &'static str) -> Exchange {
        Exchange {
            doing,
            timeout: Duration::from_millis(self.start_timeout_ms),
            timeout_setting: "world.start_timeout_ms",
        }
    }

    /// An exchange with a step's time-out: a step of all copies, or saving their state.
    const fn step_wait(&self, doing: &'static str) -> Exchange {
        Exchange {
            doing,
            timeout: Duration::from_millis(self.step_timeout_ms),
            timeout_setting: "world.step_timeout_ms",
        }
    }
}

/// Asks a command what world it is: starts it with one copy, reads its declaration, ends it.
///
/// # Errors
/// The command cannot be started, does not declare a world in time, or declares one that no run can use.
pub fn probe_command(
    command: &str,
    start_timeout_ms: u64,
    step_timeout_ms: u64,
) -> Result<ExecConfig, EnvError> {
    let undeclared = ExecConfig {
        command: command.into(),
        height: 0,
        width: 0,
        channels: 0,
        actions: Vec::new(),
        start_timeout_ms,
        step_timeout_ms,
    };
    let (process, declared) = start_process(&undeclared, &[0], Level::DEBUG)?;
    drop(process);
    let config = declared.applied_to(&undeclared);
    config.validate()?;
    Ok(config)
}

/// The seed of each copy, below 2^31 so that every language and engine has room for it.
pub(super) fn seeds(seed: u64, copies: usize) -> Vec<u32> {
    let seed = |copy| env_rng(seed, copy, RngUse::Game).random::<u32>() >> 1;
    (0..copies).map(seed).collect()
}

impl WorldSettings for ExecConfig {
    fn validate(&self) -> Result<(), EnvError> {
        let command = &self.command;
        let why = "exec: without a command; give one, as in --env \"exec:python3 world.py\"";
        require(!command.trim().is_empty(), why)?;
        let [height, width] = [self.height, self.width];
        let is_possible = [height, width].iter().all(|it| (1..=SIDE_MAX).contains(it));
        let why = format!(
            "the world `{command}` declares frames of {height} x {width} x {}; 1 x 1 x 1 to {SIDE_MAX} x {SIDE_MAX} x {CHANNELS_MAX} \
             bytes are possible, rows first, channels last",
            self.channels
        );
        require(
            is_possible && (1..=CHANNELS_MAX).contains(&self.channels),
            why,
        )?;
        let actions = self.actions.len();
        let why = format!(
            "the world `{command}` declares {actions} actions; 1 to {ACTIONS_MAX} are possible"
        );
        require((1..=ACTIONS_MAX).contains(&actions), why)?;
        for (name, value) in [
            ("start_timeout_ms", self.start_timeout_ms),
            ("step_timeout_ms", self.step_timeout_ms),
        ] {
            let why =
                format!("world.{name} = {value}; 1 to {TIMEOUT_MS_MAX} milliseconds are possible");
            require((1..=TIMEOUT_MS_MAX).contains(&value), why)?;
        }
        Ok(())
    }

    fn steps_time_max(&self, steps: u32) -> Duration {
        Duration::from_millis(self.start_timeout_ms + u64::from(steps) * self.step_timeout_ms)
    }

    /// `height` x `width` x `channels`.
    fn frame_shape(&self) -> FrameShape {
        FrameShape::new(self.height, self.width, self.channels)
    }

    fn action_names(&self) -> Vec<&str> {
        self.actions.iter().map(String::as_str).collect()
    }

    fn build(&self, num_envs: usize, seed: u64, _threads: usize) -> BuildResult {
        Ok(Box::new(ExecWorld::new(self, num_envs, seed)?))
    }

    fn variants() -> Variants {
        Variants {
            key: "command",
            names: &[],
            is_free_text: true,
        }
    }

    fn variant(&self) -> Option<&str> {
        Some(&self.command)
    }
}

impl Environment for ExecWorld {
    fn frame_shape(&self) -> FrameShape {
        self.config.frame_shape()
    }

    fn num_actions(&self) -> usize {
        self.config.actions.len()
    }

    fn num_envs(&self) -> usize {
        self.num_envs
    }

    fn observe(&mut self, frames: &mut [u8]) {
        check_frames(frames, self.num_envs, self.config.frame_shape());
        self.block
            .read_frames(frames)
            .expect("it is memory of this process, whose size is sealed");
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32], ends: &mut [StepEnd]) -> StepResult {
        check_step(self.num_envs, self.num_actions(), actions, rewards, ends)?;
        self.process.exchange = self.config.step_wait("in the middle of a step");
        let written = self.block.write_actions(actions);
        written.map_err(|e| self.process.io_error(&e))?;
        self.process.request(STEP)?;
        self.expect_done()?;
        let numbers = self.block.read_results(rewards);
        let numbers = numbers.map_err(|e| self.process.io_error(&e))?;
        for (copy, (end, &number)) in ends.iter_mut().zip(numbers).enumerate() {
            *end = match number {
                0 => StepEnd::Running,
                1 => StepEnd::LevelChange,
                2 => StepEnd::TimedOut,
                3 => StepEnd::Terminal,
                number => {
                    return Err(self.process.error(&format!(
                        "ended the step of copy {copy} with {number}; 0 runs on, 1 is the next level, 2 timed out, 3 terminal"
                    )));
                }
            };
        }
        if let Some(copy) = rewards.iter().position(|reward| !reward.is_finite()) {
            let wrong = format!("gave copy {copy} the reward {}", rewards[copy]);
            return Err(self.process.error(&wrong));
        }
        Ok(())
    }

    fn save(&mut self) -> Result<Vec<u8>, EnvError> {
        if !self.can_save {
            return Err(EnvError::not_saved());
        }
        let state = self.save_process()?;
        let mut frames = vec![0; self.num_envs * self.config.frame_shape().bytes()];
        self.observe(&mut frames);
        saved::encode(&ExecState {
            config: self.config.clone(),
            copies: self.num_envs,
            frames,
            state,
        })
    }

    fn load(&mut self, state: &[u8]) -> Result<(), EnvError> {
        let ExecState { frames, state, .. } =
            ExecState::from_bytes(state, &self.config, self.num_envs)?;
        if !self.can_save {
            return Err(EnvError::not_saved());
        }
        // Loading has the start's time-out, as a world may have to replay an episode.
        self.process.exchange = self.config.start_wait("in the middle of loading its state");
        let memory = state_file(&state)
            .and_then(|memory| self.block.write_frames(&frames).map(|()| memory))
            .map_err(|e| self.process.io_error(&e))?;
        self.request_state(LOAD, &memory)?;
        self.expect_done()
    }
}
