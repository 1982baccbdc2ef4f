//! What this machine offers, and the sizes of a run that follow from it.
//! It measures no speed: how long a run takes is estimated in `plan`.

use std::fs;

use serde::{Deserialize, Serialize};

use crate::units::kib;

/// Environments in one actor: enough for batched inference, few enough for a quick round of chunks.
pub const ENVS: u32 = 16;
/// Share of the free memory that a replay sized by the machine may take; the learner and the system need the rest.
const REPLAY_SHARE: f64 = 0.5;
/// Share of the free memory that a replay may take whose size was asked for.
const REPLAY_SHARE_MAX: f64 = 0.9;

/// What a learner takes on Procgen (266 MiB measured), and some room.
const LEARNER_BYTES: u64 = 512 << 20;
/// What an actor of 16 environments takes on Procgen, whose engine holds its pictures (410 to 423 MiB measured), and elsewhere (97 MiB
/// on Ms. PacMan).
const ACTOR_BYTES: (u64, u64) = (430 << 20, 100 << 20);

/// About the bytes that `actors` processes take in a world.
pub fn actors_bytes(actors: u32, world: &str) -> u64 {
    let (procgen, other) = ACTOR_BYTES;
    let each = match world.starts_with("procgen") {
        true => procgen,
        false => other,
    };
    u64::from(actors) * each
}

/// What this machine offers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Machine {
    /// Cores that this process may use.
    pub cores: u32,
    /// Memory that can be taken now, bytes.
    pub memory_bytes: u64,
    /// Whether its processor multiplies faster in bf16 than in f32.
    pub fast_bf16: bool,
}

impl Machine {
    /// This one. Where the memory cannot be read, 4 GiB are assumed.
    pub fn this() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get() as u32);
        Self {
            cores,
            memory_bytes: free_memory_bytes().unwrap_or(4 << 30),
            fast_bf16: driml_model::is_bf16_fast(),
        }
    }

    /// Actor processes. Few: one actor feeds several learners' worth of cores, as an update takes 32 steps only.
    pub const fn actors(&self) -> u32 {
        match self.cores {
            0..4 => 1,
            4..16 => 2,
            _ => 4,
        }
    }

    /// Bytes that a replay sized by the machine may take, where the actors take `actors_bytes`.
    pub fn replay_bytes(&self, actors_bytes: u64) -> u64 {
        self.share(REPLAY_SHARE, actors_bytes)
    }

    /// Bytes that a replay may take whose size was asked for, where the actors take `actors_bytes`.
    pub fn replay_bytes_max(&self, actors_bytes: u64) -> u64 {
        self.share(REPLAY_SHARE_MAX, actors_bytes)
    }

    fn share(&self, share: f64, actors_bytes: u64) -> u64 {
        let bytes = (self.memory_bytes as f64 * share) as u64;
        bytes.min(self.beside_actors(actors_bytes))
    }

    /// Bytes that actors and learner leave.
    pub const fn beside_actors(&self, actors_bytes: u64) -> u64 {
        let taken = actors_bytes.saturating_add(LEARNER_BYTES);
        self.memory_bytes.saturating_sub(taken)
    }
}

/// The machine that measured, as far as figures depend on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MachineNote {
    /// The processor's name.
    pub processor: String,
    /// Cores that this process may use.
    pub cores: u32,
    /// Mean number of tasks that wanted a core in the minute before.
    pub load: f64,
    /// The GPU that computed, with its memory; none if the processor did.
    #[serde(default)]
    pub gpu: Option<String>,
}

impl MachineNote {
    /// What this machine is and how busy it is now; `gpu` computes, or the processor.
    pub fn this(gpu: Option<String>) -> Self {
        Self {
            processor: processor(),
            cores: Machine::this().cores,
            load: load(&fs::read_to_string("/proc/loadavg").unwrap_or_default()).unwrap_or(0.0),
            gpu,
        }
    }
}

fn load(loadavg: &str) -> Option<f64> {
    loadavg.split_whitespace().next()?.parse().ok()
}

/// The processor's name; "unknown" where the kernel does not say it.
pub fn processor() -> String {
    let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    processor_in(&cpuinfo).unwrap_or("unknown").to_owned()
}

fn processor_in(cpuinfo: &str) -> Option<&str> {
    let mut lines = cpuinfo.lines();
    let line = lines.find(|line| line.starts_with("model name"))?;
    let (_, name) = line.split_once(':')?;
    Some(name.trim())
}

/// The kernel's estimate of available memory, or what the control group leaves, if that is less.
fn free_memory_bytes() -> Option<u64> {
    let system = kib(&fs::read_to_string("/proc/meminfo").ok()?, "MemAvailable:")? << 10;
    let number = |path: &str| fs::read_to_string(path).ok()?.trim().parse::<u64>().ok();
    let group = number("/sys/fs/cgroup/memory.max")
        .zip(number("/sys/fs/cgroup/memory.current"))
        .map(|(max, used)| max.saturating_sub(used));
    Some(group.map_or(system, |group| group.min(system)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn load_and_processor_are_read_from_the_kernel_s_tables() {
        assert_eq!(load("6.60 5.35 4.10 3/200 1234"), Some(6.6));
        let cpuinfo = "processor\t: 0\nmodel name\t: AMD EPYC 9999\nflags\t: fpu\n";
        assert_eq!(processor_in(cpuinfo), Some("AMD EPYC 9999"));
        assert_eq!(processor_in(""), None);
    }

    #[test]
    fn every_machine_gets_at_least_one_of_each() {
        for cores in [0, 1, 2, 8, 300] {
            let machine = Machine {
                cores,
                ..Machine::default()
            };
            assert!((1..=4).contains(&machine.actors()));
        }
        assert!(Machine::this().cores >= 1);
    }
}
