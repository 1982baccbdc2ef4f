//! What every run needs of the machine: cores, vector instructions and the kernels that use them, memory, shared memory, disk, and
//! Procgen's engine. The numbers are what is free now; `plan` says how large a run becomes. Nothing is fetched.

use std::path::Path;

use driml_model::{Precision, describe_kernels};
use driml_protocol::shared_memory::{self, lockable_bytes};
use nix::sys::statvfs::statvfs;
use procgen_sys::{Engine, ProcgenError};

use super::fact::{Fact, Finding, State};
use crate::{
    resources::{LEARNER_BYTES, Machine},
    units::gib,
};

/// With less memory a run's three processes do not fit, bytes: they take 0.9 GiB with a small replay.
const MEMORY_MIN: u64 = 1 << 30;
/// With less memory a replay sized by the machine holds fewer frames than a short run has, bytes.
const MEMORY_ENOUGH: u64 = 4 << 30;
/// Shared memory that the batches and one actor's chunks take, rounded up, bytes.
const SHARED_MEMORY_ENOUGH: u64 = 256 << 20;
/// With less disk space not even one checkpoint is sure to fit, bytes.
const DISK_MIN: u64 = 100 << 20;
/// Disk space that a long run's checkpoints, metrics and logs take, rounded up, bytes.
const DISK_ENOUGH: u64 = 1 << 30;
const FRAME_BYTES: u64 = 64 * 64 * 3;

/// All facts about the host. `runs` is the folder that would hold the run folders.
pub(super) fn facts(runs: &Path) -> Vec<Fact> {
    let machine = Machine::detect();
    let [f32, bf16] = Precision::ALL.map(describe_kernels);
    let kernels = format!("precision \"f32\": {f32}; \"bf16\": {bf16}");
    let all = [
        ("cores", cores(&machine)),
        ("vectors", vectors(vector_lanes())),
        ("kernels", State::Ok.with(kernels)),
        ("memory", memory(&machine)),
        ("shared memory", shared_memory(shared_memory::free_bytes())),
        ("locked memory", locked_memory(lockable_bytes())),
        ("disk", disk(runs)),
        ("Procgen", engine()),
    ];
    all.map(|(what, found)| Fact::new(what, found)).into()
}

fn cores(machine: &Machine) -> Finding {
    let (cores, actors) = (machine.cores, machine.default_actors());
    let text = format!("{cores}, all used by the learner; --actors defaults to {actors}");
    match cores {
        0 | 1 => State::Note.with(text + "; all processes share this core"),
        _ => State::Ok.with(text),
    }
}

/// Number of f32 lanes of the vector instructions that the kernels can use; 1 without AVX2 and FMA.
#[cfg(target_arch = "x86_64")]
fn vector_lanes() -> Option<u32> {
    let has_avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    Some(match (is_x86_feature_detected!("avx512f"), has_avx2) {
        (true, _) => 16,
        (false, true) => 8,
        (false, false) => 1,
    })
}

#[cfg(not(target_arch = "x86_64"))]
fn vector_lanes() -> Option<u32> {
    None
}

fn vectors(lanes: Option<u32>) -> Finding {
    match lanes {
        None => {
            let arch = std::env::consts::ARCH;
            State::Note.with(format!("{arch}, not x86-64: its speed was never measured"))
        }
        Some(16) => State::Ok.with("AVX-512: 16 float32 at once"),
        Some(8) => State::Ok.with("AVX2 and FMA: 8 float32 at once; AVX-512 is missing"),
        Some(_) => State::Note.with(
            "no AVX2 with FMA: matrix products are many times slower; does a virtual machine hide them?",
        ),
    }
}

fn memory(machine: &Machine) -> Finding {
    let (free, replay) = (machine.memory_bytes, machine.replay_bytes(LEARNER_BYTES));
    let text = format!(
        "{} free; a replay sized by the machine takes {}, {:.2} million of Procgen's frames",
        gib(free),
        gib(replay),
        (replay / FRAME_BYTES) as f64 / 1e6
    );
    let least = format!(": a run needs {} at least", gib(MEMORY_MIN));
    let (state, advice) = match free {
        ..MEMORY_MIN => (State::Missing, &*least),
        MEMORY_MIN..MEMORY_ENOUGH => (State::Note, "; --set replay.compression=lz4 makes more fit"),
        _ => (State::Ok, ""),
    };
    (state, text + advice)
}

fn shared_memory(free: Result<u64, String>) -> Finding {
    let folder = shared_memory::FOLDER;
    let why = match free {
        Ok(free) if free >= SHARED_MEMORY_ENOUGH => {
            return State::Ok.with(format!("{} free in {folder}", gib(free)));
        }
        Ok(free) => format!(
            "{} MiB free in {folder}, and a run takes up to {}: sockets are used instead, several times slower; a container needs --shm-size=1g",
            free >> 20,
            SHARED_MEMORY_ENOUGH >> 20
        ),
        Err(why) => format!("{why}: sockets are used instead, several times slower"),
    };
    State::Note.with(why)
}

/// `limit` is the number of bytes of shared memory that a process may lock; none if unlimited. zenoh locks what it shares.
fn locked_memory(limit: Option<u64>) -> Finding {
    match limit {
        None => State::Ok.with("no limit (`ulimit -l`)"),
        Some(limit) if limit >= SHARED_MEMORY_ENOUGH => {
            State::Ok.with(format!("{} MiB (`ulimit -l`)", limit >> 20))
        }
        Some(limit) => State::Note.with(format!(
                "`ulimit -l` allows {} KiB, and a run with one actor locks up to {} MiB of shared memory: sockets are used instead, several times slower; to raise it, add \
                 \"USER - memlock unlimited\" to /etc/security/limits.conf and log in again; a service needs LimitMEMLOCK=infinity, a \
                 container --ulimit memlock=-1",
                limit >> 10,
                SHARED_MEMORY_ENOUGH >> 20
            )),
    }
}

fn disk(runs: &Path) -> Finding {
    let runs = std::path::absolute(runs).unwrap_or_else(|_| runs.into());
    let existing = runs.ancestors().find(|it| it.exists()).unwrap_or(&runs);
    let hint = "; --run-dir puts a run elsewhere";
    let folder = existing.display();
    match (free_disk_bytes(existing), tempfile::tempfile_in(existing)) {
        (Ok(free), Ok(_)) => {
            let text = format!("{} free in {folder}", gib(free));
            match free {
                0..DISK_MIN => State::Missing.with(text + hint),
                DISK_MIN..DISK_ENOUGH => State::Note.with(text + hint),
                _ => State::Ok.with(text),
            }
        }
        (Err(why), _) => State::Missing.with(why),
        (_, Err(why)) => State::Missing.with(format!("{folder} cannot be written to: {why}{hint}")),
    }
}

fn free_disk_bytes(folder: &Path) -> Result<u64, String> {
    let disk = statvfs(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    Ok(disk.blocks_available().saturating_mul(disk.fragment_size()))
}

/// Whether Procgen's engine is in the cache folder and loads.
fn engine() -> Finding {
    match Engine::locate().and_then(|engine| engine.check_loads().map(|()| engine)) {
        Ok(engine) => {
            let library = engine.library().display();
            State::Ok.with(format!("the engine is {library} and loads"))
        }
        Err(ProcgenError::Missing { reason, .. }) => {
            not_installed(&reason, Engine::describe_source())
        }
        Err(why) => State::Missing.with(why.to_string()),
    }
}

/// The fact for an engine that is not installed; `source` is where it would be downloaded from.
fn not_installed(reason: &str, source: Result<String, ProcgenError>) -> Finding {
    match source {
        Ok(source) => State::Note.with(format!(
            "the engine: {reason}; `driml procgen install` gets it from {source}, and so does the first run that needs it"
        )),
        Err(why) => State::Missing.with(why.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fact_has_its_state() {
        let machine = |cores, memory_bytes| Machine {
            cores,
            memory_bytes,
            fast_bf16: false,
        };
        let no_pip = ProcgenError::Fetch("install python3-pip".into());
        for (found, state) in [
            (vectors(Some(16)), State::Ok),
            (vectors(Some(8)), State::Ok),
            (vectors(Some(1)), State::Note),
            (vectors(None), State::Note),
            (memory(&machine(2, 1 << 29)), State::Missing),
            (memory(&machine(2, 2 << 30)), State::Note),
            (memory(&machine(2, 8 << 30)), State::Ok),
            // Docker's default.
            (shared_memory(Ok(64 << 20)), State::Note),
            (shared_memory(Ok(1 << 30)), State::Ok),
            (shared_memory(Err("no such folder".into())), State::Note),
            // The kernel's usual limit for an ordinary account.
            (locked_memory(Some(8 << 20)), State::Note),
            (locked_memory(Some(1 << 30)), State::Ok),
            (locked_memory(None), State::Ok),
            (cores(&machine(1, 0)), State::Note),
            (cores(&machine(2, 0)), State::Ok),
            (not_installed("", Ok("`pip`".into())), State::Note),
            (not_installed("", Err(no_pip)), State::Missing),
        ] {
            assert_eq!(found.0, state, "{found:?}");
        }
        let (_, locked) = locked_memory(Some(8 << 20));
        assert!(locked.contains("`ulimit -l` allows 8192 KiB"), "{locked}");
        assert!(locked.contains(" locks up to 256 MiB"), "{locked}");
        let (_, fetched) = not_installed("", Ok("`pip`".into()));
        assert!(fetched.contains("`driml procgen install`"), "{fetched}");
    }

    #[test]
    fn a_folder_that_is_not_there_yet_is_judged_by_the_one_above() {
        let folder = tempfile::tempdir().unwrap();
        let (_, text) = disk(&folder.path().join("runs/one"));
        let existing = folder.path().display().to_string();
        assert!(text.contains(&existing) && !text.contains("runs"), "{text}");
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        let (state, text) = disk(&file.join("runs"));
        assert_eq!(state, State::Missing, "{text}");
        assert!(text.contains("file cannot be written to: "), "{text}");
    }
}
