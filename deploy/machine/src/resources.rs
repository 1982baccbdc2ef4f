//! The resources of this machine, and the sizes of a run that follow from them.
//! This module measures no speed: `plan` estimates how long a run takes.

use std::{fs, path::Path};

use serde::{Deserialize, Serialize};

use crate::units::proc_kib;

/// Environments of one actor: enough for batched inference, few enough that each environment soon completes a chunk.
pub const ENVS_PER_ACTOR: u32 = 16;
/// Share of the free memory that a replay sized by the machine may take; the learner and the system need the rest.
const REPLAY_SHARE: f64 = 0.5;
/// Share of the free memory that a replay of a requested size may take, where other processes of the run start beside it.
const REPLAY_SHARE_MAX: f64 = 0.9;

/// Memory of a learner on Procgen, bytes: 266 MiB measured, and some room.
pub const LEARNER_BYTES: u64 = 512 << 20;

/// The environment variable through which a sweep gives a run its share of the free memory, in bytes.
pub const MEMORY_SHARE_ENV: &str = "DRIML_MEMORY_SHARE";

/// Estimates the bytes that `actors` processes of 16 environments take in a world. Procgen's engine keeps its images in memory
/// (410 to 423 MiB measured per actor; 97 MiB on Ms. PacMan).
pub fn actors_bytes(actors: u32, world: &str) -> u64 {
    let each: u64 = match world.starts_with("procgen") {
        true => 430 << 20,
        false => 100 << 20,
    };
    u64::from(actors) * each
}

/// The resources of this machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Machine {
    /// Cores that this process may use.
    pub cores: u32,
    /// Memory that can be allocated now, bytes; a run of a sweep sees no more than its share.
    pub memory_bytes: u64,
    /// Whether the processor multiplies faster in bf16 than in f32.
    pub fast_bf16: bool,
}

impl Machine {
    /// Reads the resources of this machine. Where the memory cannot be read, 4 GiB are assumed.
    pub fn detect() -> Self {
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get() as u32);
        let share = std::env::var(MEMORY_SHARE_ENV).ok();
        let share = share.and_then(|it| it.parse().ok()).unwrap_or(u64::MAX);
        Self {
            cores,
            memory_bytes: free_memory_bytes().unwrap_or(4 << 30).min(share),
            fast_bf16: driml_model::is_bf16_fast(),
        }
    }

    /// The default number of actor processes. Few, as an update needs only 32 new steps: one actor feeds several learners' worth of cores.
    pub const fn default_actors(&self) -> u32 {
        match self.cores {
            0..4 => 1,
            4..16 => 2,
            _ => 4,
        }
    }

    /// Bytes that a replay sized by the machine may take, if the processes that start beside it take `other_bytes` bytes.
    pub fn replay_bytes(&self, other_bytes: u64) -> u64 {
        self.share_bytes(REPLAY_SHARE, other_bytes)
    }

    /// Bytes that a replay of a requested size may take, if the processes that start beside it take `other_bytes` bytes.
    pub fn replay_bytes_max(&self, other_bytes: u64) -> u64 {
        match other_bytes {
            0 => self.memory_bytes,
            _ => self.share_bytes(REPLAY_SHARE_MAX, other_bytes),
        }
    }

    fn share_bytes(&self, share: f64, other_bytes: u64) -> u64 {
        let bytes = (self.memory_bytes as f64 * share) as u64;
        bytes.min(self.memory_bytes.saturating_sub(other_bytes))
    }
}

/// A description of the machine that measured, as far as measured figures depend on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MachineInfo {
    /// The processor's name.
    pub processor: String,
    /// Cores that this process may use.
    pub cores: u32,
    /// Mean number of tasks that wanted a core in the last minute before the measurement.
    pub load: f64,
    /// The name and memory of the GPU that computed; none if the processor computed.
    pub gpu: Option<String>,
}

impl MachineInfo {
    /// Describes this machine and its load now. `gpu` is the GPU that computes, or none for the processor.
    pub fn detect(gpu: Option<String>) -> Self {
        let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
        let load = load.split_whitespace().next();
        Self {
            processor: processor_name(),
            cores: Machine::detect().cores,
            load: load.and_then(|it| it.parse().ok()).unwrap_or(0.0),
            gpu,
        }
    }
}

/// The processor's name; "unknown" if the kernel does not report it.
pub fn processor_name() -> String {
    let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let mut lines = cpuinfo.lines();
    let line = lines.find_map(|line| line.strip_prefix("model name"));
    let name = line.and_then(|line| line.split_once(':'));
    name.map_or("unknown", |(_, name)| name.trim()).to_owned()
}

/// The kernel's estimate of available memory, or what the control groups leave, whichever is less.
fn free_memory_bytes() -> Option<u64> {
    let table = fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let system = proc_kib(&table, "MemAvailable:").map(|kib| kib << 10);
    let groups = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let left = cgroup_bytes_left(Path::new("/sys/fs/cgroup"), &groups);
    system.into_iter().chain(left).min()
}

/// Bytes that a process's control groups leave it: the least over its group and all parents, for cgroup versions 1 and 2.
/// `groups` is the process's `/proc/PID/cgroup`. The page cache of files counts as free, as the kernel reclaims it.
fn cgroup_bytes_left(mount: &Path, groups: &str) -> Option<u64> {
    let left = |group: &Path, [max, used, cache]: [&str; 3]| {
        let text = |file: &str| fs::read_to_string(group.join(file)).ok();
        let number = |file| text(file)?.trim().parse::<u64>().ok();
        let stat = text("memory.stat").unwrap_or_default();
        let cached = ["active_file", "inactive_file"].map(|list| {
            let mut lines = stat.lines();
            let bytes = lines.find_map(|it| it.strip_prefix(cache)?.strip_prefix(list));
            bytes.and_then(|it| it.trim().parse().ok()).unwrap_or(0)
        });
        let used = number(used)?.saturating_sub(cached.iter().sum());
        Some(number(max)?.saturating_sub(used))
    };
    let lines = groups.lines().filter_map(|line| {
        let mut parts = line.splitn(3, ':').skip(1);
        let (controllers, group) = (parts.next()?, parts.next()?.trim_start_matches('/'));
        let (mount, files) = match controllers {
            "" => (mount.to_owned(), ["memory.max", "memory.current", ""]),
            _ if controllers.split(',').any(|it| it == "memory") => (
                mount.join("memory"),
                ["memory.limit_in_bytes", "memory.usage_in_bytes", "total_"],
            ),
            _ => return None,
        };
        // In a container the mount point may be the process's own group, whatever that group's path on the host.
        let all = Path::new(group).ancestors();
        all.filter_map(|group| left(&mount.join(group), files))
            .min()
    });
    lines.min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_groups_leave_what_the_tightest_leaves_and_cached_files_are_free() {
        let root = tempfile::tempdir().unwrap();
        let group = |path: &str, files: &str| {
            let folder = root.path().join(path);
            fs::create_dir_all(&folder).unwrap();
            for (name, text) in files.split(", ").filter_map(|it| it.split_once(' ')) {
                fs::write(folder.join(name), format!("{text}\n")).unwrap();
            }
        };
        let left = |groups| cgroup_bytes_left(root.path(), groups);
        assert_eq!(left("0::/\n"), None);
        let stat = "anon 500\nfile 450\nactive_file 200\ninactive_file 100";
        let files = format!("memory.max 1000, memory.current 900, memory.stat {stat}");
        group("job", &files);
        group("job/step", "memory.max max, memory.current 800");
        // The parent's limit of 1000 applies, less the 900 in use, of which 300 bytes are page cache.
        assert_eq!(left("0::/job/step\n"), Some(400));
        group("", "memory.max 700, memory.current 600");
        assert_eq!(left("0::/job/step\n"), Some(100));
        assert_eq!(left("0::/of/the/host\n"), Some(100));
        let stat = "active_file 1\ntotal_active_file 30\ntotal_inactive_file 20";
        let limits = "memory.limit_in_bytes 90, memory.usage_in_bytes 80";
        group("memory/job", &format!("{limits}, memory.stat {stat}"));
        assert_eq!(left("4:cpu,cpuacct:/job\n3:memory:/job\n"), Some(60));
        assert_eq!(left("4:cpu,cpuacct:/job\n"), None);
    }
}
