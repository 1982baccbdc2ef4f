//! What every run needs of the machine: cores, vector instructions and what the kernels make of them, memory, shared memory, disk.
//! The numbers are what is free now; how large a run becomes is for `plan`.

use std::path::Path;

use driml_model::{Precision, kernels_in_words};
use driml_protocol::shared_memory::{self, lockable_bytes};
use nix::sys::statvfs::statvfs;

use super::fact::{Fact, State};
use crate::{resources::Machine, units::gib};

/// Below this a run's three processes do not fit, bytes: they take 0.9 GiB with a small replay.
const MEMORY_MIN: u64 = 1 << 30;
/// Below this the replay sized by the machine holds less than a short run's frames, bytes.
const MEMORY_ENOUGH: u64 = 4 << 30;
/// What the batches and one actor's chunks take of it, rounded up, bytes.
const SHARED_MEMORY_ENOUGH: u64 = 256 << 20;
/// Below this not even one checkpoint is sure to fit, bytes.
const DISK_MIN: u64 = 100 << 20;
/// What a long run's checkpoints, metrics and logs take, rounded up, bytes.
const DISK_ENOUGH: u64 = 1 << 30;
/// Bytes of one of Procgen's frames.
const FRAME_BYTES: u64 = 64 * 64 * 3;

/// Vector instructions that the kernels of the matrix products can use.
#[derive(Clone, Copy, Debug)]
struct Vectors {
    avx2: bool,
    fma: bool,
    avx512f: bool,
}

/// All of them. `runs` is where run folders would be.
pub(super) fn facts(runs: &Path) -> Vec<Fact> {
    let machine = Machine::this();
    vec![
        cores(machine.cores),
        vectors(Vectors::this()),
        kernels(),
        memory(&machine),
        shared_memory(shared_memory::free_bytes()),
        locked_memory(lockable_bytes()),
        disk(runs),
    ]
}

impl Vectors {
    #[cfg(target_arch = "x86_64")]
    fn this() -> Option<Self> {
        Some(Self {
            avx2: std::is_x86_feature_detected!("avx2"),
            fma: std::is_x86_feature_detected!("fma"),
            avx512f: std::is_x86_feature_detected!("avx512f"),
        })
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn this() -> Option<Self> {
        None
    }
}

fn cores(cores: u32) -> Fact {
    let machine = Machine {
        cores,
        memory_bytes: 0,
        fast_bf16: false,
    };
    let text = format!(
        "{cores}, all of them for the learner; --actors is {} unless given",
        machine.actors()
    );
    match cores {
        0 | 1 => Fact::note("cores", format!("{text}; all processes share it")),
        _ => Fact::ok("cores", text),
    }
}

fn vectors(found: Option<Vectors>) -> Fact {
    let what = "vectors";
    match found {
        None => Fact::note(
            what,
            format!(
                "not x86-64 but {}: it was never measured there",
                std::env::consts::ARCH
            ),
        ),
        Some(Vectors { avx512f: true, .. }) => Fact::ok(what, "AVX-512: 16 float32 at once"),
        Some(Vectors {
            avx2: true,
            fma: true,
            ..
        }) => Fact::ok(what, "AVX2 and FMA: 8 float32 at once; there is no AVX-512"),
        Some(_) => Fact::note(
            what,
            "no AVX2 with FMA: matrix products are many times slower; does a virtual machine hide them?",
        ),
    }
}

/// What the network's products run on, in either precision.
fn kernels() -> Fact {
    let [f32, bf16] = Precision::ALL.map(kernels_in_words);
    let text = format!("precision \"f32\": {f32}; \"bf16\": {bf16}");
    Fact::ok("kernels", text)
}

fn memory(machine: &Machine) -> Fact {
    let (free, replay) = (machine.memory_bytes, machine.replay_bytes(0));
    let text = format!(
        "{} free; a replay sized by the machine takes {}, {:.2} million of Procgen's frames",
        gib(free),
        gib(replay),
        (replay / FRAME_BYTES) as f64 / 1e6
    );
    let (state, more) = match free {
        ..MEMORY_MIN => {
            let least = format!(": a run needs {} at least", gib(MEMORY_MIN));
            (State::Missing, least)
        }
        MEMORY_MIN..MEMORY_ENOUGH => {
            let packed = "; --set replay.compression=lz4 makes more fit";
            (State::Note, packed.to_owned())
        }
        _ => (State::Ok, String::new()),
    };
    Fact::new(state, "memory", text + &more)
}

fn shared_memory(free: Result<u64, String>) -> Fact {
    let (what, folder) = ("shared memory", shared_memory::FOLDER);
    let why = match free {
        Ok(free) if free >= SHARED_MEMORY_ENOUGH => {
            return Fact::ok(what, format!("{} free in {folder}", gib(free)));
        }
        Ok(free) => format!(
            "{} MiB free in {folder}, a run takes up to {}: sockets serve instead, several times slower; a container needs --shm-size=1g",
            free >> 20,
            SHARED_MEMORY_ENOUGH >> 20
        ),
        Err(why) => format!("{why}: sockets serve instead, several times slower"),
    };
    Fact::note(what, why)
}

/// `limit` is how many bytes of shared memory a process may lock, as it has to; none if there is no limit.
fn locked_memory(limit: Option<u64>) -> Fact {
    let what = "locked memory";
    match limit {
        None => Fact::ok(what, "no limit (`ulimit -l`)"),
        Some(limit) if limit >= SHARED_MEMORY_ENOUGH => {
            Fact::ok(what, format!("{} MiB (`ulimit -l`)", limit >> 20))
        }
        Some(limit) => Fact::note(
            what,
            format!(
                "`ulimit -l` allows {} KiB, a run with one actor locks up to {} MiB of shared memory: sockets serve instead, several times slower; to raise it, add \
                 \"USER - memlock unlimited\" to /etc/security/limits.conf and log in again; a service needs LimitMEMLOCK=infinity, a \
                 container --ulimit memlock=-1",
                limit >> 10,
                SHARED_MEMORY_ENOUGH >> 10
            ),
        ),
    }
}

fn disk(runs: &Path) -> Fact {
    let runs = std::path::absolute(runs).unwrap_or_else(|_| runs.into());
    let there = runs.ancestors().find(|it| it.is_dir()).unwrap_or(&runs);
    match (free(there), tempfile::tempfile_in(there)) {
        (Ok(free), Ok(_)) => {
            let text = format!("{} free in {}", gib(free), there.display());
            let more = "; --run-dir puts a run elsewhere";
            let state = match free {
                0..DISK_MIN => State::Missing,
                DISK_MIN..DISK_ENOUGH => State::Note,
                _ => return Fact::ok("disk", text),
            };
            Fact::new(state, "disk", text + more)
        }
        (Err(why), _) => Fact::missing("disk", why),
        (_, Err(why)) => Fact::missing(
            "disk",
            format!(
                "{} cannot be written to: {why}; --run-dir puts a run elsewhere",
                there.display()
            ),
        ),
    }
}

/// Bytes that this user can still write there.
fn free(folder: &Path) -> Result<u64, String> {
    statvfs(folder)
        .map(|it| it.blocks_available().saturating_mul(it.fragment_size()))
        .map_err(|e| format!("{}: {e}", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fact_has_its_state() {
        let vectors_of = |avx2, fma, avx512f| vectors(Some(Vectors { avx2, fma, avx512f })).state;
        assert_eq!(vectors_of(true, true, true), State::Ok);
        assert_eq!(vectors_of(true, true, false), State::Ok);
        assert_eq!(vectors_of(true, false, false), State::Note);
        assert_eq!(vectors(None).state, State::Note);
        let machine = |memory_bytes| Machine {
            cores: 2,
            memory_bytes,
            fast_bf16: false,
        };
        let memory_of = |bytes| memory(&machine(bytes)).state;
        assert_eq!(memory_of(1 << 29), State::Missing);
        assert_eq!(memory_of(2 << 30), State::Note);
        assert_eq!(memory_of(8 << 30), State::Ok);
        // What docker grants unless it is told otherwise.
        assert_eq!(shared_memory(Ok(64 << 20)).state, State::Note);
        assert_eq!(shared_memory(Ok(1 << 30)).state, State::Ok);
        let none = shared_memory(Err("no such folder".into()));
        assert_eq!(none.state, State::Note);
        // The kernel's usual limit for an ordinary account.
        let locked = locked_memory(Some(8 << 20));
        assert_eq!(locked.state, State::Note);
        let why = "`ulimit -l` allows 8192 KiB";
        assert!(locked.text.contains(why), "{locked}");
        assert_eq!(locked_memory(Some(1 << 30)).state, State::Ok);
        assert_eq!(locked_memory(None).state, State::Ok);
        assert_eq!(cores(1).state, State::Note);
        assert_eq!(cores(2).state, State::Ok);
    }

    #[test]
    fn a_folder_that_is_not_there_yet_is_judged_by_the_one_above() {
        let folder = tempfile::tempdir().unwrap();
        let fact = disk(&folder.path().join("runs/one"));
        let there = folder.path().display().to_string();
        assert!(fact.text.contains(&there), "{fact}");
        assert!(!fact.text.contains("runs"), "{fact}");
    }
}
