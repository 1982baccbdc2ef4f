//! Detects which resources limited by the system this process has nearly used up.
//! This module ends no process. A library's own error says what failed, but seldom which resource was short.

use std::fs;

use driml_protocol::shared_memory::{self, FOLDER, METADATA_BYTES};
use nix::{
    errno::Errno,
    sys::resource::{Resource, getrlimit},
};

use crate::{resources::Machine, units::proc_kib};

/// Open files that a library may need at once, to connect or to share memory. With fewer left, files are scarce.
const FILES_SPARE: u64 = 8;
const MAPS_SPARE: u64 = 64;
const MEMORY_SPARE: u64 = 64 << 20;

/// Lists the resources that this process has nearly used up: each with its limit and what to do.
pub fn scarce_resources() -> Vec<String> {
    let all = [open_files(), shared_memory(), locked_memory()];
    let all = all.into_iter().chain([memory_maps(), memory()]);
    all.flatten().collect()
}

fn open_files() -> Option<String> {
    let (max, _) = getrlimit(Resource::RLIMIT_NOFILE).ok()?;
    let used = match fs::read_dir("/proc/self/fd") {
        // Reading the folder takes one descriptor.
        Ok(entries) => (entries.count() as u64).saturating_sub(1),
        Err(e) if e.raw_os_error() == Some(Errno::EMFILE as i32) => max,
        Err(_) => return None,
    };
    (used.saturating_add(FILES_SPARE) > max)
        .then(|| format!("{used} of at most {max} files are open: raise the limit (`ulimit -n`)"))
}

fn shared_memory() -> Option<String> {
    let free = shared_memory::free_bytes().ok()?;
    (free < METADATA_BYTES as u64).then(|| {
        format!(
            "{free} bytes are free in {FOLDER}: make it larger (a container needs --shm-size), or --set transport.shared_memory=false"
        )
    })
}

fn locked_memory() -> Option<String> {
    let max = shared_memory::lockable_bytes()?;
    let locked = proc_kib(&fs::read_to_string("/proc/self/status").ok()?, "VmLck:")? << 10;
    (locked + METADATA_BYTES as u64 > max).then(|| {
        format!(
            "{} of at most {} KiB of memory are locked: raise the limit (`ulimit -l`), or --set transport.shared_memory=false",
            locked >> 10,
            max >> 10
        )
    })
}

fn memory_maps() -> Option<String> {
    let max = fs::read_to_string("/proc/sys/vm/max_map_count").ok()?;
    let max: u64 = max.trim().parse().ok()?;
    let used = fs::read_to_string("/proc/self/maps").ok()?.lines().count() as u64;
    (used + MAPS_SPARE > max)
        .then(|| format!("{used} of at most {max} memory maps are used: raise vm.max_map_count"))
}

fn memory() -> Option<String> {
    let free = Machine::detect().memory_bytes;
    (free < MEMORY_SPARE).then(|| format!("{} MiB of memory are free", free >> 20))
}
