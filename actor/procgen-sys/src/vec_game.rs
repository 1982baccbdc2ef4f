//! Environments of one game, stepped together: the safe interface of the engine.
//! It passes on the engine's flags unchanged and does not interpret them as episodes.

use std::ffi::c_void;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::error::ProcgenError;
use crate::ffi::{self, DTYPE_INT32, DTYPE_UINT8, Handle, LibenvBuffers, LibenvTensortype};
use crate::game::Game;
use crate::install::Engine;
use crate::library::{self, Api};
use crate::nap::Nap;
use crate::options::{self, NUM_ACTIONS, Options};
use crate::pinned::Pinned;

/// Rows and columns of a frame.
pub const FRAME_SIDE: usize = 64;

/// Bytes of a frame: 64 x 64 pixels, red, green and blue.
pub const FRAME_BYTES: usize = FRAME_SIDE * FRAME_SIDE * 3;

/// The action that takes the game's no-op and then ends the episode, whatever happened.
pub const RESET: i32 = -1;

/// The first size of a state's buffer, in bytes; doubled when a state takes more than half. The engine ends the process
/// if a state does not fit; states seen are below 100 kB.
const STATE_BYTES_START: usize = 1 << 20;

/// An environment's complete state, as the engine wrote it. The engine trusts what it reads back: a forged one may end
/// the process, so load states from your own files alone.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    game: Game,
    bytes: Vec<u8>,
}

impl State {
    /// The engine's bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }
}

/// N environments of one game. One thread at a time may use a `VecGame`; different threads may use different ones.
pub struct VecGame {
    api: &'static Api,
    handle: Handle,
    game: Game,
    num_envs: usize,
    state_capacity: usize,
    /// The sleep before waiting for the engine's threads; `None` if the calling thread steps.
    nap: Option<Nap>,
    // The engine keeps the addresses of all of these until `close`, which `Drop` calls before they are freed.
    frames: Pinned<u8>,
    rewards: Pinned<f32>,
    first: Pinned<u8>,
    prev_level_seed: Pinned<i32>,
    prev_level_complete: Pinned<u8>,
    level_seed: Pinned<i32>,
    actions: Pinned<i32>,
}

// SAFETY: the engine ties a handle to no thread; it asks only that one thread at a time uses it (gym3's `libenv.h`),
// which `&mut self` ensures. Its own threads touch the buffers only between `act` and `observe`, inside `act` here.
unsafe impl Send for VecGame {}

impl VecGame {
    /// Makes the environments and resets them. The first one in a process reads all pictures (1 to 3 s).
    ///
    /// # Errors
    /// Settings that the engine does not take, a library that cannot be loaded, or one that is not version 0.10.7.
    pub fn new(engine: &Engine, options: &Options) -> Result<VecGame, ProcgenError> {
        options.validate()?;
        let api = library::load(engine.library())?;
        let assets = engine.assets();
        // The engine reads files by joining strings and ends the process when one is missing.
        let resource_root = match assets.to_str() {
            Some(path) if assets.is_dir() => format!("{path}/"),
            found => {
                let reason =
                    found.map_or("is not UTF-8; set DRIML_CACHE to another", |_| "is gone");
                let folder = assets.display();
                return Err(ProcgenError::Unexpected(format!(
                    "its folder of pictures {folder} {reason}"
                )));
            }
        };
        let n = options.num_envs;
        let num_envs = i32::try_from(n).expect("validated to be small");
        let handle = options::with_raw_options(options, &resource_root, |raw| {
            // SAFETY: the settings were validated, are laid out as the engine reads them, and live until after the call.
            unsafe { (api.make)(num_envs, raw) }
        });
        if handle.is_null() {
            return Err(ProcgenError::Unexpected("it made no game".to_owned()));
        }
        let game = VecGame {
            api,
            handle,
            game: options.game,
            num_envs: n,
            state_capacity: STATE_BYTES_START,
            nap: (options.num_threads > 0).then(Nap::default),
            frames: Pinned::new(0, n * FRAME_BYTES),
            rewards: Pinned::new(0.0, n),
            first: Pinned::new(0, n),
            prev_level_seed: Pinned::new(0, n),
            prev_level_complete: Pinned::new(0, n),
            level_seed: Pinned::new(0, n),
            actions: Pinned::new(0, n),
        };
        game.check_tensors()?;
        game.set_buffers();
        Ok(game)
    }

    /// Number of environments, N.
    pub fn num_envs(&self) -> usize {
        self.num_envs
    }

    /// The current frames [N, 64, 64, 3].
    pub fn frames(&self) -> &[u8] {
        self.read(&self.frames)
    }

    /// The rewards of the last actions [N]; 0 before the first.
    pub fn rewards(&self) -> &[f32] {
        self.read(&self.rewards)
    }

    /// 1 where the current frame is the first of an episode [N].
    pub fn first(&self) -> &[u8] {
        self.read(&self.first)
    }

    /// 1 where the last action completed its level [N].
    pub fn prev_level_complete(&self) -> &[u8] {
        self.read(&self.prev_level_complete)
    }

    /// The level that the current frame shows [N].
    pub fn level_seed(&self) -> &[i32] {
        self.read(&self.level_seed)
    }

    fn read<'a, T: Copy>(&'a self, buffer: &'a Pinned<T>) -> &'a [T] {
        // SAFETY: the engine writes only inside `act` and `set_state`, which take `&mut self`.
        unsafe { buffer.as_slice() }
    }

    /// Takes one action in every environment, each in `0..15` or `RESET`, and waits for the results.
    ///
    /// # Errors
    /// Not N actions, or one out of range; nothing was stepped.
    pub fn act(&mut self, actions: &[i32]) -> Result<(), ProcgenError> {
        let (n, game) = (self.num_envs, self.game);
        let error = |text| Err(ProcgenError::Action(text));
        let count = actions.len();
        if count != n {
            return error(format!("{count} actions for {n} environments of {game}"));
        }
        let valid = RESET..NUM_ACTIONS as i32;
        if let Some(env) = actions.iter().position(|action| !valid.contains(action)) {
            let action = actions[env];
            return error(format!(
                "action {action} for environment {env} of {game}; 0 to 14 exist"
            ));
        }
        // `act` below is the only call during which the engine reads the actions.
        self.actions.write(actions);
        let started = Instant::now();
        // SAFETY: the handle is open, the buffers are set, and no reference into them is alive thanks to `&mut self`.
        unsafe { (self.api.act)(self.handle) };
        if let Some(nap) = &self.nap {
            nap.sleep();
        }
        // SAFETY: as for `act`. It returns once every environment is stepped, so that nothing is written after this.
        unsafe { (self.api.observe)(self.handle) };
        if let Some(nap) = &mut self.nap {
            nap.update(started.elapsed());
        }
        Ok(())
    }

    /// Returns the complete state of environment `env`, including its level and generators.
    pub fn state(&mut self, env: usize) -> Result<State, ProcgenError> {
        let index = self.env_index(env)?;
        let mut bytes = vec![0_u8; self.state_capacity];
        // The engine may write 4 bytes past the length it is told (`write_string` forgets its own prefix).
        let len =
            i32::try_from(self.state_capacity - 8).expect("doubled from 1 MiB with a limit below");
        // SAFETY: the handle is open, `index` is one of its environments, and `bytes` is longer than `len`.
        let used =
            unsafe { (self.api.get_state)(self.handle, index, bytes.as_mut_ptr().cast(), len) };
        let used = usize::try_from(used).ok();
        let used = used.filter(|used| *used < bytes.len());
        let used = used.ok_or_else(|| {
            ProcgenError::Unexpected("it wrote a state of an impossible size".to_owned())
        })?;
        if used > self.state_capacity / 2 && self.state_capacity < 1 << 28 {
            self.state_capacity *= 2;
        }
        bytes.truncate(used);
        bytes.shrink_to_fit();
        Ok(State {
            game: self.game,
            bytes,
        })
    }

    /// Puts environment `env` into a state of the same game; its frame, reward and flags become those of that state.
    pub fn set_state(&mut self, env: usize, state: &State) -> Result<(), ProcgenError> {
        let index = self.env_index(env)?;
        if state.game != self.game {
            return Err(ProcgenError::State(format!(
                "a state of {} for an environment of {}",
                state.game, self.game
            )));
        }
        let len = i32::try_from(state.bytes.len()).expect("the engine gave its length as an i32");
        let bytes = state.bytes.as_ptr().cast_mut().cast();
        // SAFETY: the handle is open, its buffers are set, `index` is one of its environments, and the bytes are what the
        // engine wrote for this game. It only reads them; the pointer is `*mut` for want of `const` in its header.
        unsafe { (self.api.set_state)(self.handle, index, bytes, len) };
        Ok(())
    }

    fn env_index(&self, env: usize) -> Result<i32, ProcgenError> {
        if env >= self.num_envs {
            return Err(ProcgenError::State(format!(
                "environment {env} of {} environments of {}",
                self.num_envs, self.game
            )));
        }
        Ok(i32::try_from(env).expect("below num_envs, which is small"))
    }

    /// Checks that the engine has exactly the tensors for which the buffers above are made.
    fn check_tensors(&self) -> Result<(), ProcgenError> {
        let side = FRAME_SIDE as i32;
        let frame = ffi::describe_tensor("rgb", DTYPE_UINT8, &[side, side, 3]);
        let number = |name, dtype| ffi::describe_tensor(name, dtype, &[]);
        let infos = [
            number("prev_level_seed", DTYPE_INT32),
            number("prev_level_complete", DTYPE_UINT8),
            number("level_seed", DTYPE_INT32),
        ];
        for (space, expected) in [
            (ffi::SPACE_OBSERVATION, &[frame][..]),
            (ffi::SPACE_ACTION, &[number("action", DTYPE_INT32)]),
            (ffi::SPACE_INFO, &infos),
        ] {
            let null = std::ptr::null_mut();
            // SAFETY: the handle is open; with a null pointer the engine only counts.
            let count = unsafe { (self.api.get_tensortypes)(self.handle, space, null) };
            let mut types = vec![LibenvTensortype::zeroed(); usize::try_from(count).unwrap_or(0)];
            // SAFETY: the engine writes as many types as it just counted, and there is room for them.
            unsafe { (self.api.get_tensortypes)(self.handle, space, types.as_mut_ptr()) };
            let found: Vec<_> = types.iter().map(LibenvTensortype::describe).collect();
            if found != expected {
                let (found, expected) = (found.join(", "), expected.join(", "));
                return Err(ProcgenError::Unexpected(format!(
                    "its buffers are {found}, not {expected}"
                )));
            }
        }
        Ok(())
    }

    /// Tells the engine where to read and write, which also does the first reset. Call this once only.
    fn set_buffers(&self) {
        let per_env = |address: &dyn Fn(usize) -> *mut c_void| {
            (0..self.num_envs).map(address).collect::<Vec<_>>()
        };
        let mut ob = per_env(&|env| self.frames.address(env * FRAME_BYTES).cast());
        let mut ac = per_env(&|env| self.actions.address(env).cast());
        // In the order of the tensors that `check_tensors` has seen.
        let mut info = per_env(&|env| self.prev_level_seed.address(env).cast());
        info.extend(per_env(&|env| self.prev_level_complete.address(env).cast()));
        info.extend(per_env(&|env| self.level_seed.address(env).cast()));
        let mut buffers = LibenvBuffers {
            ob: ob.as_mut_ptr(),
            rew: self.rewards.address(0),
            first: self.first.address(0),
            info: info.as_mut_ptr(),
            ac: ac.as_mut_ptr(),
        };
        // SAFETY: every address lies in memory that `self` keeps in place until the handle is closed, with the sizes
        // that `check_tensors` has confirmed; the engine copies the pointer arrays. No reference into the buffers is
        // alive, and `observe` returns once the first frames are written.
        unsafe {
            (self.api.set_buffers)(self.handle, &raw mut buffers);
            (self.api.observe)(self.handle);
        }
    }
}

impl Drop for VecGame {
    fn drop(&mut self) {
        // SAFETY: the handle is open and not used again; the engine joins its threads before this returns.
        unsafe { (self.api.close)(self.handle) };
    }
}
