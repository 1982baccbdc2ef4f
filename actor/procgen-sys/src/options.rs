//! The engine's settings, checked in Rust and laid out as the engine reads them.
//! It omits what the engine cannot save and restore (generated assets) and what only people see (the large picture).

use std::ffi::c_void;

use crate::error::ProcgenError;
use crate::ffi::{self, DTYPE_INT32, DTYPE_UINT8, LibenvOption, LibenvOptions};
use crate::game::{DistributionMode, Game};

/// Number of actions; valid ones are `0..15`.
pub const NUM_ACTIONS: usize = 15;

/// The most environments of one handle; more are rejected.
pub const NUM_ENVS_MAX: usize = 4096;

/// The most threads that one handle starts; more are rejected.
pub const NUM_THREADS_MAX: usize = 256;

/// The settings for `VecGame::new`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// The game.
    pub game: Game,
    /// Environments of one game, stepped together: 1 to `NUM_ENVS_MAX`.
    pub num_envs: usize,
    /// Size of the set from which levels are drawn, `start_level..start_level + num_levels`; 0 means every level, `0..2^31 - 1`.
    pub num_levels: i32,
    /// The first level of the set; 0 or more.
    pub start_level: i32,
    /// Seeds the choice of levels. All other randomness depends on the level alone.
    pub rand_seed: i32,
    /// Threads that the handle starts to step environments; 0 steps in the calling thread.
    pub num_threads: usize,
    /// How hard the levels are; not every game has every mode.
    pub distribution_mode: DistributionMode,
    /// Whether a completed level is followed by the level numbered 997 higher, without `first`.
    pub use_sequential_levels: bool,
    /// Whether the agent's velocity is painted into the upper left corner, in the games where it matters.
    pub paint_vel_info: bool,
    /// Whether backgrounds are pictures rather than black.
    pub use_backgrounds: bool,
    /// Whether the view follows the agent, in the games where it does.
    pub center_agent: bool,
    /// Whether each kind of thing has one look only.
    pub restrict_themes: bool,
}

impl Options {
    /// Returns an error that says why, if the engine cannot take these settings.
    pub fn validate(&self) -> Result<(), ProcgenError> {
        let (num_envs, num_threads) = (self.num_envs, self.num_threads);
        let (num_levels, start_level) = (self.num_levels, self.start_level);
        let (game, mode) = (self.game, self.distribution_mode);
        let text = if num_envs == 0 || num_envs > NUM_ENVS_MAX {
            format!("{num_envs} environments; 1 to {NUM_ENVS_MAX} are possible")
        } else if num_threads > NUM_THREADS_MAX {
            format!("{num_threads} threads; 0 to {NUM_THREADS_MAX} are possible")
        } else if num_levels < 0 || start_level < 0 {
            format!(
                "num_levels = {num_levels}, start_level = {start_level}; neither may be negative"
            )
        } else if start_level.checked_add(num_levels).is_none() {
            format!(
                "start_level {start_level} + num_levels {num_levels} is past the last level, 2147483647"
            )
        } else if num_levels == 0 && start_level != 0 {
            format!(
                "start_level = {start_level} has no effect with num_levels = 0 (every level); set one of them otherwise"
            )
        } else if !game.has_mode(mode) {
            let games = Game::ALL.into_iter().filter(|game| game.has_mode(mode));
            let games: Vec<&str> = games.map(Game::name).collect();
            format!(
                "{game} has no distribution mode \"{mode}\"; easy and hard work, and these games have that one: {}",
                games.join(", ")
            )
        } else {
            return Ok(());
        };
        Err(ProcgenError::Options(text))
    }
}

/// Passes checked settings to `make` in the engine's layout, which is valid until `make` returns. `resource_root` is
/// the folder of the pictures, with a slash at its end.
pub(crate) fn with_raw_options<T>(
    options: &Options,
    resource_root: &str,
    make: impl FnOnce(LibenvOptions) -> T,
) -> T {
    let text = |value: &str| (DTYPE_UINT8, value.len(), value.as_bytes().to_vec());
    let int = |value: i32| (DTYPE_INT32, 1, value.to_ne_bytes().to_vec());
    let flag = |value: bool| (DTYPE_UINT8, 1, vec![u8::from(value)]);
    let to_i32 = |number: usize| i32::try_from(number).expect("validated to be small");
    let mut table = [
        ("env_name", text(options.game.name())),
        ("resource_root", text(resource_root)),
        ("num_levels", int(options.num_levels)),
        ("start_level", int(options.start_level)),
        ("num_actions", int(to_i32(NUM_ACTIONS))),
        ("rand_seed", int(options.rand_seed)),
        ("num_threads", int(to_i32(options.num_threads))),
        ("debug_mode", int(0)),
        ("distribution_mode", int(options.distribution_mode as i32)),
        ("render_human", flag(false)),
        ("use_generated_assets", flag(false)),
        ("use_monochrome_assets", flag(false)),
        ("use_sequential_levels", flag(options.use_sequential_levels)),
        ("paint_vel_info", flag(options.paint_vel_info)),
        ("use_backgrounds", flag(options.use_backgrounds)),
        ("center_agent", flag(options.center_agent)),
        ("restrict_themes", flag(options.restrict_themes)),
    ];
    let mut items = table
        .each_mut()
        .map(|(name, (dtype, count, value))| LibenvOption {
            name: ffi::option_name(name),
            dtype: *dtype,
            count: to_i32(*count),
            data: value.as_mut_ptr().cast::<c_void>(),
        });
    make(LibenvOptions {
        items: items.as_mut_ptr(),
        count: to_i32(items.len()),
    })
}
