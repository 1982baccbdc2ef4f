//! The engine's settings, checked in Rust and laid out as the engine reads them.
//! It does not offer what the engine cannot save and restore (generated assets) nor what only people see (the large picture).

use std::ffi::c_void;

use crate::ffi::{self, DTYPE_INT32, DTYPE_UINT8, LibenvOption, LibenvOptions};
use crate::game::{DistributionMode, Game};

/// Number of actions; valid ones are `0..15`.
pub const NUM_ACTIONS: usize = 15;

/// Copies of a game that one handle may hold; more is refused.
pub const NUM_ENVS_MAX: usize = 4096;

/// Threads that one handle may start; more is refused.
pub const NUM_THREADS_MAX: usize = 256;

/// What `VecGame::new` needs to know.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Options {
    /// The game.
    pub game: Game,
    /// Copies of the game, stepped together: 1 to `NUM_ENVS_MAX`.
    pub num_envs: usize,
    /// Size of the set from which levels are drawn, `start_level..start_level + num_levels`; 0 means every level, `0..2^31 - 1`.
    pub num_levels: i32,
    /// The first level of the set; 0 or more.
    pub start_level: i32,
    /// Seeds the choice of levels; the only source of randomness that is not the level's own.
    pub rand_seed: i32,
    /// Threads that the handle starts for itself; 0 steps in the calling thread.
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

/// Settings with which the engine would end the process, and what to do instead.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("procgen settings: {0}")]
pub struct OptionsError(String);

impl Options {
    /// Says why the engine could not take these settings.
    ///
    /// # Errors
    /// Numbers out of range, or a mode that the game does not have.
    pub fn validate(&self) -> Result<(), OptionsError> {
        let fail = |text: String| Err(OptionsError(text));
        if self.num_envs == 0 || self.num_envs > NUM_ENVS_MAX {
            return fail(format!(
                "{} copies of the game; 1 to {NUM_ENVS_MAX} are possible",
                self.num_envs
            ));
        }
        if self.num_threads > NUM_THREADS_MAX {
            return fail(format!(
                "{} threads; 0 to {NUM_THREADS_MAX} are possible",
                self.num_threads
            ));
        }
        if self.num_levels < 0 || self.start_level < 0 {
            return fail(format!(
                "num_levels = {}, start_level = {}; neither may be negative",
                self.num_levels, self.start_level
            ));
        }
        if self.start_level.checked_add(self.num_levels).is_none() {
            return fail(format!(
                "start_level {} + num_levels {} is past the last level, 2147483647",
                self.start_level, self.num_levels
            ));
        }
        if self.num_levels == 0 && self.start_level != 0 {
            return fail(format!(
                "start_level = {} has no effect with num_levels = 0 (every level); set one of them otherwise",
                self.start_level
            ));
        }
        if !self.game.has(self.distribution_mode) {
            let games: Vec<&str> = Game::ALL
                .iter()
                .filter(|game| game.has(self.distribution_mode))
                .map(|game| game.name())
                .collect();
            return fail(format!(
                "{} has no distribution mode \"{}\"; easy and hard work, and these games have that one: {}",
                self.game,
                self.distribution_mode,
                games.join(", ")
            ));
        }
        Ok(())
    }
}

/// The settings in the engine's layout, with the memory they point to.
pub(crate) struct RawOptions {
    items: Vec<LibenvOption>,
    /// Each item's value; an item points into one of these. Boxes, so that the addresses stay when the vector grows.
    values: Vec<Box<[u8]>>,
}

impl RawOptions {
    /// Lays out checked settings. `resource_root` is the folder of the pictures, with a slash at its end.
    pub(crate) fn new(options: &Options, resource_root: &str) -> RawOptions {
        let mut raw = RawOptions {
            items: Vec::new(),
            values: Vec::new(),
        };
        let int = |number: usize| i32::try_from(number).expect("validated to be small");
        raw.string("env_name", options.game.name());
        raw.string("resource_root", resource_root);
        raw.int("num_levels", options.num_levels);
        raw.int("start_level", options.start_level);
        raw.int("num_actions", int(NUM_ACTIONS));
        raw.int("rand_seed", options.rand_seed);
        raw.int("num_threads", int(options.num_threads));
        raw.int("debug_mode", 0);
        raw.int("distribution_mode", options.distribution_mode.number());
        raw.bool("render_human", false);
        raw.bool("use_generated_assets", false);
        raw.bool("use_monochrome_assets", false);
        raw.bool("use_sequential_levels", options.use_sequential_levels);
        raw.bool("paint_vel_info", options.paint_vel_info);
        raw.bool("use_backgrounds", options.use_backgrounds);
        raw.bool("center_agent", options.center_agent);
        raw.bool("restrict_themes", options.restrict_themes);
        raw
    }

    /// The struct that `libenv_make` takes by value; it points into `self`, which must outlive the call.
    pub(crate) fn as_libenv(&mut self) -> LibenvOptions {
        let count = i32::try_from(self.items.len()).expect("there are 17 options");
        LibenvOptions {
            items: self.items.as_mut_ptr(),
            count,
        }
    }

    fn string(&mut self, name: &str, value: &str) {
        self.item(name, DTYPE_UINT8, value.len(), value.as_bytes());
    }

    fn int(&mut self, name: &str, value: i32) {
        self.item(name, DTYPE_INT32, 1, &value.to_ne_bytes());
    }

    fn bool(&mut self, name: &str, value: bool) {
        self.item(name, DTYPE_UINT8, 1, &[u8::from(value)]);
    }

    fn item(&mut self, name: &str, dtype: u32, count: usize, bytes: &[u8]) {
        let mut value: Box<[u8]> = bytes.into();
        let data = value.as_mut_ptr().cast::<c_void>();
        let count = i32::try_from(count).expect("an option's value is short");
        self.items.push(LibenvOption {
            name: ffi::name(name),
            dtype,
            count,
            data,
        });
        self.values.push(value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> Options {
        Options {
            game: Game::Coinrun,
            num_envs: 2,
            num_levels: 500,
            start_level: 0,
            rand_seed: 1,
            num_threads: 0,
            distribution_mode: DistributionMode::Easy,
            use_sequential_levels: true,
            paint_vel_info: true,
            use_backgrounds: true,
            center_agent: true,
            restrict_themes: false,
        }
    }

    #[test]
    fn what_would_end_the_process_is_refused_with_the_value() {
        assert_eq!(options().validate(), Ok(()));
        let refused = |change: fn(&mut Options), text: &str| {
            let mut options = options();
            change(&mut options);
            let error = options.validate().unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        };
        refused(|o| o.num_envs = 0, "0 copies");
        refused(|o| o.num_envs = NUM_ENVS_MAX + 1, "4097 copies");
        refused(|o| o.num_threads = 1000, "1000 threads");
        refused(|o| o.num_levels = -1, "num_levels = -1");
        refused(|o| o.start_level = -1, "start_level = -1");
        refused(|o| o.start_level = i32::MAX, "past the last level");
        refused(|o| (o.num_levels, o.start_level) = (0, 7), "no effect");
        refused(
            |o| o.distribution_mode = DistributionMode::Extreme,
            "chaser, dodgeball, leaper, starpilot",
        );
        refused(
            |o| o.distribution_mode = DistributionMode::Memory,
            "caveflyer, dodgeball, heist, jumper, maze, miner",
        );
    }

    #[test]
    fn values_lie_where_the_items_point() {
        let mut raw = RawOptions::new(&options(), "/somewhere/");
        assert_eq!(raw.as_libenv().count, 17);
        for (item, value) in raw.items.iter().zip(&raw.values) {
            assert_eq!(item.data.cast_const().cast::<u8>(), value.as_ptr());
        }
        assert_eq!(&*raw.values[0], b"coinrun");
        assert_eq!(&*raw.values[2], &500_i32.to_ne_bytes());
    }
}
