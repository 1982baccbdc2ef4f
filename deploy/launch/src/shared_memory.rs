//! The shared memory that a process leaves behind in `/dev/shm`. zenoh's own bookkeeping keeps some of it open to the end of the
//! process, so that it stays there until the next one sweeps; a process that ends in order removes it itself.
//! What others use too, or could use, it leaves alone.

use std::{collections::BTreeSet, fs, path::PathBuf};

use driml_protocol::shared_memory::FOLDER;

/// What the names of zenoh's segments end with.
const EXTENSION: &str = ".zenoh";

/// Removes the segments of shared memory that this process alone has in its memory. It must not use them any more.
pub fn remove_own() {
    for path in own() {
        let removed = fs::remove_file(&path);
        tracing::debug!("removing {}: {removed:?}", path.display());
    }
}

/// The segments that no other process has in its memory.
fn own() -> BTreeSet<PathBuf> {
    let mut own = segments("self");
    let this = std::process::id();
    for entry in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let pid = entry.file_name().to_string_lossy().into_owned();
        if pid.parse::<u32>().is_ok_and(|it| it != this) {
            let theirs = segments(&pid);
            own.retain(|it| !theirs.contains(it));
        }
    }
    own
}

/// The segments that a process has in its memory.
fn segments(pid: &str) -> BTreeSet<PathBuf> {
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).unwrap_or_default();
    let paths = maps
        .lines()
        .filter_map(|line| line.split_whitespace().nth(5));
    let segments = paths.filter(|it| it.starts_with(FOLDER) && it.ends_with(EXTENSION));
    segments.map(PathBuf::from).collect()
}

#[cfg(test)]
mod tests {
    use zenoh::{Wait, shm::ShmProviderBuilder};

    use super::*;

    #[test]
    fn a_segment_that_this_process_alone_has_is_its_own() {
        let before = own();
        let pool = ShmProviderBuilder::default_backend(1 << 12).wait().unwrap();
        let found = own();
        assert!(found.difference(&before).next().is_some(), "{found:?}");
        assert!(found.is_subset(&segments(&std::process::id().to_string())));
        drop(pool);
    }
}
