//! The values on which all processes of one run must agree, and their hash, which is in every message.
//! Settings that only one process uses are not among them.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::{
    config::{ConfigError, check, check_range},
    wire::codec,
};

/// Version of the fields of [`RunSpec`], for their hash. The protocol version may change while checkpoints stay valid.
/// A new field is optional and not serialised when absent: the hash of earlier runs, which their checkpoints contain, then stays.
const FIELDS_VERSION: u16 = 1;

/// Most positives that a row can carry; a rule that needs more is rejected.
const POSITIVES_MAX: usize = 32;

/// Most frames that make one state.
pub const FRAME_STACK_MAX: u32 = 16;

/// How far ahead a positive lies: the rule by which the replay server draws k.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "rule", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Horizon {
    /// No positive is served: the agent uses no later state. The braces make serde reject unknown fields, which a unit variant accepts.
    None {},
    /// Always k, or the steps left in the episode if these are fewer.
    Fixed {
        /// Environment steps ahead, at least 1.
        k: u32,
    },
    /// Uniform on 1..=k_max (or the steps left).
    Uniform {
        /// Environment steps ahead, at least 1.
        k_max: u32,
    },
    /// Non-homogeneous geometric along the stored actions, at most k_max (or the steps left). SPEC: DRIML-ada.
    Nhg {
        /// Environment steps ahead, at least 1.
        k_max: u32,
    },
    /// Every k of 1..=k_max, one positive each (CPC); those past the end of the episode are missing.
    All {
        /// Environment steps ahead, 1 to 32.
        k_max: u32,
    },
}

impl Horizon {
    /// Number of positives in a row: states s_{t+k} served beside s_t.
    pub const fn positives(&self) -> usize {
        match self {
            Self::None {} => 0,
            Self::Fixed { .. } | Self::Uniform { .. } | Self::Nhg { .. } => 1,
            Self::All { k_max } => *k_max as usize,
        }
    }

    /// The largest k that can be served, environment steps; 0 if no positive is served.
    pub const fn k_max(&self) -> u32 {
        match *self {
            Self::None {} => 0,
            Self::Fixed { k } => k,
            Self::Uniform { k_max } | Self::Nhg { k_max } | Self::All { k_max } => k_max,
        }
    }

    /// Whether the rule reads the action affinity, which the learner then estimates.
    pub const fn reads_affinity(&self) -> bool {
        matches!(self, Self::Nhg { .. })
    }
}

/// What a time-out means for the return.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TimeoutRule {
    /// A time-out ends the return as a terminal step does (the paper).
    Terminal,
    /// The return bootstraps from the last frame before the time-out, over the fewer steps up to it.
    Bootstrap,
}

/// The values on which all processes of one run must agree.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunSpec {
    /// The world, as given to `--env`.
    pub world: String,
    /// The agent, as given to `--agent`.
    pub agent: String,
    /// The run's seed, from which the generators of all processes are derived.
    pub seed: u64,
    /// Rows of a frame as actors send it: those rows of the world's frame that the network reads, from the top.
    pub frame_height: u32,
    /// Columns of a frame as actors send it, from the left.
    pub frame_width: u32,
    /// Bytes per pixel of a frame, as the world gives it.
    pub frame_channels: u32,
    /// Number of frames in one state, oldest first along the channels.
    pub frame_stack: u32,
    /// Number of the world's actions; valid ones are `0..num_actions`.
    pub num_actions: u32,
    /// Number of environment steps in the return.
    pub n_step: u32,
    /// Discount per step, 0 to 1.
    pub gamma: f64,
    /// The rule for k.
    pub horizon: Horizon,
    /// What a time-out means for the return.
    pub timeout: TimeoutRule,
}

impl RunSpec {
    /// The smallest valid spec, for tests, benches and checks: frames of one byte, two actions, one-step returns, no positives.
    pub fn smallest() -> Self {
        Self {
            world: "counter".into(),
            agent: "c51".into(),
            seed: 1,
            frame_height: 1,
            frame_width: 1,
            frame_channels: 1,
            frame_stack: 1,
            num_actions: 2,
            n_step: 1,
            gamma: 0.99,
            horizon: Horizon::None {},
            timeout: TimeoutRule::Terminal,
        }
    }

    /// Rows and columns of one frame as actors send it: neither stacked nor enlarged.
    pub const fn frame_size(&self) -> (usize, usize) {
        (self.frame_height as usize, self.frame_width as usize)
    }

    /// Bytes of one frame as actors send it.
    pub const fn frame_bytes(&self) -> usize {
        self.frame_height as usize * self.frame_width as usize * self.frame_channels as usize
    }

    /// Bytes of one state: `frame_stack` frames.
    pub const fn state_bytes(&self) -> usize {
        self.frame_bytes() * self.frame_stack as usize
    }

    /// The hash that is in every message and checkpoint of this run: the first 8 bytes of the SHA-256 of `FIELDS_VERSION` and the fields.
    pub fn hash(&self) -> u64 {
        let bytes = codec::encode_value(&(FIELDS_VERSION, self))
            .expect("a run spec is a few short fields, far below the limit");
        let digest = Sha256::digest(&bytes);
        u64::from_le_bytes(digest[..8].try_into().expect("SHA-256 has 32 bytes"))
    }

    /// The seed of one generator of one process: SHA-256 of the run's seed, `index` and the process's name.
    pub fn seed_for(&self, process: &str, index: u64) -> [u8; 32] {
        let mut hasher = Sha256::new();
        hasher.update(self.seed.to_le_bytes());
        hasher.update(index.to_le_bytes());
        hasher.update(process.as_bytes());
        hasher.finalize().into()
    }

    /// Checks every field's range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let mut bytes = 1_u64;
        for (key, value, max) in [
            ("run.frame_height", self.frame_height, 4096),
            ("run.frame_width", self.frame_width, 4096),
            ("run.frame_channels", self.frame_channels, 16),
            ("run.frame_stack", self.frame_stack, FRAME_STACK_MAX),
        ] {
            let why = format_args!("it lies between 1 and {max}");
            check_range(key, value, 1..=max, why)?;
            bytes *= u64::from(value);
        }
        let fits = u32::try_from(bytes).is_ok();
        let why = "with these sizes a state has 4 GiB or more";
        check(fits, "run.frame_height", self.frame_height, why)?;
        let why = "a world has 1 to 255 actions";
        check_range("run.num_actions", self.num_actions, 1..=255, why)?;
        let why = "a return spans 1 to 1000 steps";
        check_range("run.n_step", self.n_step, 1..=1000, why)?;
        let why = "a discount lies between 0 and 1";
        check_range("run.gamma", self.gamma, 0.0..=1.0, why)?;
        let (key, k_max) = ("run.horizon", self.horizon.k_max());
        if self.horizon != (Horizon::None {}) {
            check_range(key, k_max, 1..=1000, "k lies between 1 and 1000")?;
        }
        let fits = self.horizon.positives() <= POSITIVES_MAX;
        check(fits, key, k_max, "a row carries at most 32 positives")
    }
}
