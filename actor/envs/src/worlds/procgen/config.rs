//! The settings of the Procgen world, as a preset or a command line gives them.
//! Only fields that earlier versions lack have defaults: each affects what is learned, so a preset states it with its source.

use std::path::Path;

use procgen_sys::{DistributionMode, Engine, FRAME_SIDE, Game, Options};

use crate::error::{EnvError, require};

/// The number of unseen levels to draw from; they follow the levels of training.
const UNSEEN_LEVELS: u32 = 100_000;

/// Which levels of which game, and how they look.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProcgenConfig {
    /// The game, by its name: bigfish, bossfight, caveflyer, chaser, climber, coinrun, dodgeball, fruitbot, heist,
    /// jumper, leaper, maze, miner, ninja, plunder or starpilot.
    pub game: Game,
    /// How hard the levels are: `easy`, `hard`, `extreme` (chaser, dodgeball, leaper, starpilot) or `memory`
    /// (caveflyer, dodgeball, heist, jumper, maze, miner). It also decides a few time limits.
    pub distribution_mode: DistributionMode,
    /// Size of the set from which levels are drawn, in levels: `start_level..start_level + num_levels`. Few levels can
    /// be learned by heart, many cannot. 0 means all levels, `0..2^31 - 1`, and needs `start_level = 0`.
    pub num_levels: u32,
    /// Number of the first level of the set; test sets start where training sets end.
    pub start_level: u32,
    /// Whether a completed level is followed by another without ending the episode, so that the return continues. The
    /// level that follows is kept within the set; see this module's documentation.
    pub use_sequential_levels: bool,
    /// Whether the agent's velocity is painted as two grey squares into the upper left corner, in the games in which one
    /// frame does not show it. It stands in for a stack of frames.
    pub paint_vel_info: bool,
    /// Whether backgrounds are pictures, which vary from level to level, rather than black.
    pub use_backgrounds: bool,
    /// Whether the view follows the agent, in the games whose levels are larger than the view; otherwise the whole level
    /// is shown, smaller.
    pub center_agent: bool,
    /// Whether each kind of thing always looks the same, rather than differently from level to level.
    pub restrict_themes: bool,
    /// Side of a frame in pixels, 8 to 64, as it is sent, stored and learned from. The engine draws 64; smaller frames
    /// are means over areas of its picture. Settings of earlier versions lack this field and mean 64.
    #[serde(default = "engine_side")]
    pub frame_side: u32,
    /// Whether frames are grey, one byte per pixel, rather than in colour. Settings of earlier versions lack this field and mean false.
    #[serde(default)]
    pub grey: bool,
    /// The path of another build of the engine's library, `libenv.so`, with its pictures in `assets` beside it or
    /// beside its folder. If absent, the published build plays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub library: Option<String>,
}

pub(super) const fn engine_side() -> u32 {
    FRAME_SIDE as u32
}

impl ProcgenConfig {
    /// Returns the engine: the build that `library` names, or the published one, which is fetched if it is not installed.
    pub(super) fn engine(&self, progress: &mut dyn FnMut(&str)) -> Result<Engine, EnvError> {
        let engine = match &self.library {
            Some(library) => Engine::from_library(Path::new(library)),
            None => Engine::install(progress),
        };
        Ok(engine?)
    }

    /// Returns the same game with one level per episode.
    pub(crate) fn with_single_levels(&self) -> Self {
        Self {
            use_sequential_levels: false,
            ..self.clone()
        }
    }

    /// Returns the same game with one level per episode, from those behind the levels of training.
    pub(crate) fn with_unseen_levels(&self) -> Result<Self, EnvError> {
        let why = "this run trained on all levels, so none is unseen";
        require(self.num_levels > 0, why)?;
        Ok(Self {
            start_level: self.start_level + self.num_levels,
            num_levels: UNSEEN_LEVELS,
            ..self.with_single_levels()
        })
    }

    /// The engine's settings, checked.
    pub(super) fn options(
        &self,
        num_envs: usize,
        seed: u64,
        threads: usize,
    ) -> Result<Options, EnvError> {
        let level = |name: &str, number: u32| {
            i32::try_from(number).map_err(|_| {
                EnvError::Config(format!(
                    "{name} = {number}; levels are numbered below 2147483647"
                ))
            })
        };
        let options = Options {
            game: self.game,
            num_envs,
            num_levels: level("num_levels", self.num_levels)?,
            start_level: level("start_level", self.start_level)?,
            rand_seed: rand_seed(seed),
            num_threads: threads,
            distribution_mode: self.distribution_mode,
            use_sequential_levels: self.use_sequential_levels,
            paint_vel_info: self.paint_vel_info,
            use_backgrounds: self.use_backgrounds,
            center_agent: self.center_agent,
            restrict_themes: self.restrict_themes,
        };
        options.validate()?;
        Ok(options)
    }
}

/// The engine's 31-bit seed for a 64-bit one, well mixed, so that neighbouring seeds draw unrelated levels.
///
/// Source: the output function of SplitMix64 (Steele, Lea and Flood 2014).
fn rand_seed(seed: u64) -> i32 {
    let mut z = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 33) as i32
}
