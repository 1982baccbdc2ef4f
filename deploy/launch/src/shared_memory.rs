//! The shared memory that a process leaves behind in `/dev/shm`. zenoh's own bookkeeping keeps some of it open to the end of the
//! process, so that it stays there until the next one sweeps; a process that ends in order removes it itself.
//! What others use too, or could use, it leaves alone.

use std::{collections::BTreeSet, fs, path::PathBuf};

use driml_protocol::shared_memory::FOLDER;

const EXTENSION: &str = ".zenoh";

/// Removes the segments of shared memory that this process alone has in its memory. It must not use them any more.
pub fn remove_own() {
    let (mut own, this) = (segments("self"), std::process::id());
    for entry in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let pid = entry.file_name().to_string_lossy().into_owned();
        if pid.parse::<u32>().is_ok_and(|it| it != this) {
            let theirs = segments(&pid);
            own.retain(|it| !theirs.contains(it));
        }
    }
    for path in own {
        let removed = fs::remove_file(&path);
        tracing::debug!("removing {}: {removed:?}", path.display());
    }
}

/// The segments that a process has in its memory.
fn segments(pid: &str) -> BTreeSet<PathBuf> {
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).unwrap_or_default();
    let lines = maps.lines();
    let paths = lines.filter_map(|line| line.split_whitespace().nth(5));
    let segments = paths.filter(|it| it.starts_with(FOLDER) && it.ends_with(EXTENSION));
    segments.map(PathBuf::from).collect()
}
