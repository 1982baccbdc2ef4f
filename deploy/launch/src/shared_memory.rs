//! The shared memory that a process leaves behind in `/dev/shm`. zenoh's own bookkeeping keeps some segments open until the process
//! ends, so that they stay until another process sweeps. A process that exits in order therefore removes them itself.
//! Segments that other processes use, or could use, stay.

use std::{collections::BTreeSet, fs, path::PathBuf};

use driml_protocol::shared_memory::FOLDER;

const EXTENSION: &str = ".zenoh";

/// Removes the segments of shared memory that only this process has mapped. The process must not use them any more.
pub fn remove_own_segments() {
    let (mut own, this) = (mapped_segments("self"), std::process::id());
    for entry in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let pid = entry.file_name().to_string_lossy().into_owned();
        if pid.parse::<u32>().is_ok_and(|it| it != this) {
            let theirs = mapped_segments(&pid);
            own.retain(|it| !theirs.contains(it));
        }
    }
    for path in own {
        let removed = fs::remove_file(&path);
        tracing::debug!("removing {}: {removed:?}", path.display());
    }
}

fn mapped_segments(pid: &str) -> BTreeSet<PathBuf> {
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).unwrap_or_default();
    let lines = maps.lines();
    let paths = lines.filter_map(|line| line.split_whitespace().nth(5));
    let segments = paths.filter(|it| it.starts_with(FOLDER) && it.ends_with(EXTENSION));
    segments.map(PathBuf::from).collect()
}
