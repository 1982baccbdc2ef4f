//! What every run needs of the machine: cores, vector instructions and what the kernels make of them, memory, shared memory, disk.
//! The numbers are what is free now; how large a run becomes is for `plan`.

use std::path::Path;

use driml_model::{Precision, describe_kernels};
use driml_protocol::shared_memory::{self, lockable_bytes};
use nix::sys::statvfs::statvfs;

use super::fact::{Fact, State};
use crate::{
    resources::{LEARNER_BYTES, Machine},
    units::gib,
};

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
const FRAME_BYTES: u64 = 64 * 64 * 3;

/// All of them. `runs` is where run folders would be.
pub(super) fn facts(runs: &Path) -> Vec<Fact> {
    let machine = Machine::this();
    vec![
        cores(&machine),
        vectors(floats_at_once()),
        kernels(),
        memory(&machine),
        shared_memory(shared_memory::free_bytes()),
        locked_memory(lockable_bytes()),
        disk(runs),
    ]
}

fn cores(machine: &Machine) -> Fact {
    let (cores, actors) = (machine.cores, machine.actors());
    let text = format!("{cores}, all of them for the learner; --actors is {actors} unless given");
    match cores {
        0 | 1 => Fact::note("cores", format!("{text}; all processes share it")),
        _ => Fact::ok("cores", text),
    }
}

/// Floats that the vector instructions take at once which the kernels can use; 1 without AVX2 and FMA.
#[cfg(target_arch = "x86_64")]
fn floats_at_once() -> Option<u32> {
    let has_avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    Some(match (is_x86_feature_detected!("avx512f"), has_avx2) {
        (true, _) => 16,
        (false, true) => 8,
        (false, false) => 1,
    })
}

#[cfg(not(target_arch = "x86_64"))]
fn floats_at_once() -> Option<u32> {
    None
}

fn vectors(at_once: Option<u32>) -> Fact {
    let what = "vectors";
    match at_once {
        None => {
            let arch = std::env::consts::ARCH;
            let text = format!("not x86-64 but {arch}: it was never measured there");
            Fact::note(what, text)
        }
        Some(16) => Fact::ok(what, "AVX-512: 16 float32 at once"),
        Some(8) => Fact::ok(what, "AVX2 and FMA: 8 float32 at once; there is no AVX-512"),
        Some(_) => Fact::note(
            what,
            "no AVX2 with FMA: matrix products are many times slower; does a virtual machine hide them?",
        ),
    }
}

/// What the network's products run on, in either precision.
fn kernels() -> Fact {
    let [f32, bf16] = Precision::ALL.map(describe_kernels);
    let text = format!("precision \"f32\": {f32}; \"bf16\": {bf16}");
    Fact::ok("kernels", text)
}

fn memory(machine: &Machine) -> Fact {
    let (free, replay) = (machine.memory_bytes, machine.replay_bytes(LEARNER_BYTES));
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
                SHARED_MEMORY_ENOUGH >> 20
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

fn free(folder: &Path) -> Result<u64, String> {
    let disk = statvfs(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
    Ok(disk.blocks_available().saturating_mul(disk.fragment_size()))
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
        for (fact, state) in [
            (vectors(Some(16)), State::Ok),
            (vectors(Some(8)), State::Ok),
            (vectors(Some(1)), State::Note),
            (vectors(None), State::Note),
            (memory(&machine(2, 1 << 29)), State::Missing),
            (memory(&machine(2, 2 << 30)), State::Note),
            (memory(&machine(2, 8 << 30)), State::Ok),
            // What docker grants unless it is told otherwise.
            (shared_memory(Ok(64 << 20)), State::Note),
            (shared_memory(Ok(1 << 30)), State::Ok),
            (shared_memory(Err("no such folder".into())), State::Note),
            // The kernel's usual limit for an ordinary account.
            (locked_memory(Some(8 << 20)), State::Note),
            (locked_memory(Some(1 << 30)), State::Ok),
            (locked_memory(None), State::Ok),
            (cores(&machine(1, 0)), State::Note),
            (cores(&machine(2, 0)), State::Ok),
        ] {
            assert_eq!(fact.state, state, "{fact}");
        }
        let locked = locked_memory(Some(8 << 20)).text;
        assert!(locked.contains("`ulimit -l` allows 8192 KiB"), "{locked}");
        assert!(locked.contains(" locks up to 256 MiB"), "{locked}");
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
