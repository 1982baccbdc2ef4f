//! The shared memory that a process leaves behind in `/dev/shm`. zenoh's own bookkeeping keeps some of it open to the end of the
//! process, so that it stays there until the next one sweeps; a process that ends in order removes it itself.
//! What others use too, or could use, it leaves alone.

use std::{fs, os::unix::fs::MetadataExt, path::Path};

use driml_protocol::shared_memory::FOLDER;
use nix::sys::stat::{major, minor};

/// The extension of zenoh's segments. A process that has one open holds a lock on it.
const EXTENSION: &str = "zenoh";

/// Removes the segments of shared memory that this process alone holds. It must not use them any more.
pub fn remove_own() {
    let Ok(locks) = fs::read_to_string("/proc/locks") else {
        return;
    };
    for entry in fs::read_dir(FOLDER).into_iter().flatten().flatten() {
        let path = entry.path();
        let is_segment = path.extension().is_some_and(|it| it == EXTENSION);
        let file = entry.metadata().ok().filter(|_| is_segment);
        let is_own = |it: fs::Metadata| is_held_by_alone(&locks, &id(&it), std::process::id());
        if file.is_some_and(is_own) && !is_mapped_elsewhere(&path) {
            let removed = fs::remove_file(&path);
            tracing::debug!("removing {}: {removed:?}", path.display());
        }
    }
}

/// Whether another process has the file in its memory. The table of locks alone does not tell: it is read in pieces, and as others
/// lock and unlock meanwhile, lines are skipped.
fn is_mapped_elsewhere(path: &Path) -> bool {
    let own = std::process::id().to_string();
    let processes = fs::read_dir("/proc").into_iter().flatten().flatten();
    let others = processes.filter(|it| {
        let name = it.file_name();
        let name = name.to_string_lossy();
        name.bytes().all(|byte| byte.is_ascii_digit()) && name != own
    });
    let path = path.to_string_lossy();
    let maps = |it: fs::DirEntry| fs::read_to_string(it.path().join("maps")).ok();
    others
        .filter_map(maps)
        .any(|maps| maps.lines().any(|line| line.ends_with(&*path)))
}

/// What tells a file from all others in the kernel's table of locks; device numbers are hexadecimal.
fn id(file: &fs::Metadata) -> String {
    let (major, minor) = (major(file.dev()), minor(file.dev()));
    format!("{major:02x}:{minor:02x}:{}", file.ino())
}

/// Whether the process `pid` alone holds a lock on the file with this [`id`], by the table.
fn is_held_by_alone(locks: &str, id: &str, pid: u32) -> bool {
    // `1: FLOCK  ADVISORY  READ  4711 00:1a:42 0 EOF`
    let mut holders = locks.lines().filter_map(|line| {
        let words: Vec<_> = line.split_whitespace().collect();
        let at = words.iter().position(|word| *word == id)?;
        words.get(at.checked_sub(1)?)?.parse::<u32>().ok()
    });
    let first = holders.next();
    first == Some(pid) && holders.all(|holder| holder == pid)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_segment_of_this_process_alone_is_its_own() {
        let locks = "1: FLOCK  ADVISORY  READ 7 00:1a:42 0 EOF\n\
                     2: FLOCK  ADVISORY  READ 7 00:1a:43 0 EOF\n\
                     3: FLOCK  ADVISORY  READ 8 00:1a:43 0 EOF\n\
                     4: FLOCK  ADVISORY  READ 7 00:1a:42 0 EOF\n\
                     5: -> FLOCK ADVISORY WRITE 9 fe:00:42 0 EOF\n";
        let held = |id, pid| is_held_by_alone(locks, id, pid);
        assert!(held("00:1a:42", 7));
        assert!(!held("00:1a:42", 8), "another's");
        assert!(!held("00:1a:43", 7), "shared");
        assert!(!held("00:1a:44", 7), "not in use");
        assert!(!held("00:1b:42", 7), "on another device");
    }

    #[test]
    fn the_kernel_s_table_is_as_this_reads_it() {
        let file = tempfile::tempfile().unwrap();
        file.lock().unwrap();
        let id = id(&file.metadata().unwrap());
        let locks = fs::read_to_string("/proc/locks").unwrap();
        let is_held = is_held_by_alone(&locks, &id, std::process::id());
        assert!(is_held, "{id} in\n{locks}");
    }
}
