//! Runs every decoder on a bounded number of changed seeds, in CI, by the same functions that the fuzz targets call.
//! `DRIML_DECODER_RUNS=N` sets the number of executions of each.

#![allow(clippy::unwrap_used, reason = "these are tests")]

use std::{
    fs,
    path::{Path, PathBuf},
};

use driml_decoders::{DECODERS, log_with_highest_ordinal, logs, transitions_held};
use driml_settings::config::RunConfig;
use rand::{Rng, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;

/// Executions of each decoder in CI.
const RUNS: u64 = 20_000;
/// The same for the decoder `segments`, whose executions open a folder four times.
const SEGMENTS_RUNS: u64 = 1_500;
/// The most bytes of a changed seed; the rest is cut off.
const BYTES_MAX: usize = 1 << 14;

fn seeds_folder(decoder: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("fuzz/corpus")
        .join(decoder)
}

fn seeds(decoder: &str) -> Vec<Vec<u8>> {
    let mut files: Vec<_> = fs::read_dir(seeds_folder(decoder))
        .unwrap_or_else(|e| panic!("{decoder} has no seeds: {e}"))
        .map(|entry| entry.unwrap().path())
        .collect();
    files.sort();
    assert!(!files.is_empty(), "{decoder} has no seeds");
    files.iter().map(|file| fs::read(file).unwrap()).collect()
}

/// Changes some bytes, as a fuzzer does.
fn mutate(bytes: &mut Vec<u8>, seeds: &[Vec<u8>], rng: &mut ChaCha8Rng) {
    const EDGES: [u64; 8] = [0, 1, 250, 251, 1 << 31, 1 << 60, u64::MAX - 1, u64::MAX];
    for _ in 0..rng.random_range(1..5) {
        let at = rng.random_range(0..=bytes.len());
        let length = rng.random_range(0..=(bytes.len() - at).min(16));
        match rng.random_range(0..8) {
            0 if at < bytes.len() => bytes[at] ^= 1 << rng.random_range(0..8),
            1 if at < bytes.len() => bytes[at] = rng.random(),
            2 => drop(bytes.drain(at..at + length)),
            3 => {
                let copy = bytes[at..at + length].to_vec();
                bytes.splice(at..at, copy);
            }
            4 => {
                let edge = EDGES.choose(rng).unwrap().to_le_bytes();
                let width = [1, 2, 4, 8].choose(rng).copied().unwrap();
                bytes.splice(at..(at + length).min(bytes.len()), edge[..width].to_vec());
            }
            5 => {
                // bincode's markers of longer numbers.
                let mark = rng.random_range(251..=254);
                bytes.splice(at..at, [mark, 255, 255, 255, 255, 255, 255, 255, 255]);
            }
            6 => {
                let other = seeds.choose(rng).unwrap();
                let from = rng.random_range(0..=other.len());
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..]);
            }
            _ => bytes.truncate(at),
        }
    }
    bytes.truncate(BYTES_MAX);
}

fn run_decoder(name: &str) {
    let runs = std::env::var("DRIML_DECODER_RUNS").ok();
    let default = if name == "segments" {
        SEGMENTS_RUNS
    } else {
        RUNS
    };
    let runs = runs.map_or(default, |it| it.parse().expect("a number of executions"));
    let (_, decoder) = DECODERS.iter().find(|(it, _)| *it == name).unwrap();
    let seeds = seeds(name);
    seeds.iter().for_each(|seed| decoder(seed));
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for number in 0..runs {
        let mut bytes = seeds.choose(&mut rng).unwrap().clone();
        mutate(&mut bytes, &seeds, &mut rng);
        if std::panic::catch_unwind(|| decoder(&bytes)).is_err() {
            let file = std::env::temp_dir().join(format!("driml-decoder-{name}-{number}"));
            fs::write(&file, &bytes).unwrap();
            panic!("{name}, execution {number}: {}", file.display());
        }
    }
}

/// Defines a test for each decoder, and the list of their names.
macro_rules! bounded {
    ($($name:ident)*) => {
        const BOUNDED: &[&str] = &[$(stringify!($name)),*];

        $(#[test]
        fn $name() {
            run_decoder(stringify!($name));
        })*
    };
}

bounded!(messages replay state config segments);

/// Each bounded run checks that its decoder has seeds.
#[test]
fn every_decoder_has_a_bounded_run_and_a_target() {
    assert!(DECODERS.iter().map(|(name, _)| name).eq(BOUNDED));
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz");
    let manifest = fs::read_to_string(fuzz.join("Cargo.toml")).unwrap();
    assert!(fuzz.join("fuzz_targets/decoder.rs").exists());
    for (name, _) in DECODERS {
        let target = format!("name = \"{name}\"\npath = \"fuzz_targets/decoder.rs\"");
        assert!(manifest.contains(&target), "{name} has no target");
    }
}

/// A state of another format is rejected before the rest of it is read.
#[test]
fn the_states_among_the_seeds_can_be_read() {
    for seed in seeds("state") {
        driml_learner::checkpoint::check_state(&seed).unwrap();
    }
}

/// This version reads the logs among the seeds. `UPDATE_CORPUS=1` writes them; their bytes differ each time.
#[test]
fn the_logs_among_the_seeds_can_be_read() {
    for (name, log) in logs() {
        let file = seeds_folder("segments").join(name);
        if std::env::var_os("UPDATE_CORPUS").is_some() {
            fs::write(&file, &log).unwrap();
        }
        let stored = fs::read(&file).unwrap_or_default();
        let file = file.display();
        assert!(log.len() < BYTES_MAX, "{file}: too long");
        let held = transitions_held(&log);
        let is_read = !stored.is_empty() && transitions_held(&stored) == held && held > Ok(0);
        assert!(is_read, "{file}: UPDATE_CORPUS=1 writes it anew");
    }
}

#[test]
fn a_log_with_the_highest_number_is_refused() {
    let refused = transitions_held(&log_with_highest_ordinal()).unwrap_err();
    assert!(refused.contains("which no replay reaches"), "{refused}");
}

/// The settings among the seeds are those of `driml presets --preset smoke`.
#[test]
fn the_settings_among_the_seeds_can_be_read() {
    for seed in seeds("config") {
        RunConfig::parse("a seed", str::from_utf8(&seed).unwrap()).unwrap();
    }
}
