//! The folder of a run's checkpoints: lists and locks it, and writes files that survive a crash.
//! It does not know the contents of a checkpoint.

use std::{
    fs::{self, File},
    io::{ErrorKind, Write},
    path::{Path, PathBuf},
    thread::sleep,
    time::{Duration, Instant},
};

use driml_protocol::{atomic_write, lock_file};

use super::error::{CheckpointError, damaged, io_error};

/// The name of the checkpoints' folder in a run's folder.
pub const FOLDER: &str = "checkpoints";
/// How long a learner process retries its last save while the disk is full or read-only.
pub const RETRY_MAX: Duration = Duration::from_secs(600);
/// Start of a checkpoint's name; the number of its update follows.
pub(super) const PREFIX: &str = "checkpoint-";
const LOCK_FILE: &str = ".lock";
/// End of a checkpoint's name while another checkpoint of the same update replaces it.
const OLD_SUFFIX: &str = ".replaced.tmp";

/// Creates `folder`, and keeps other learners from saving in it as long as the returned file is open.
pub fn lock(folder: &Path) -> Result<File, CheckpointError> {
    fs::create_dir_all(folder).map_err(io_error("create", folder))?;
    let path = folder.join(LOCK_FILE);
    let lock = lock_file::acquire(&path, "let no other learner save there");
    let lock = lock.map_err(io_error("create", &path))?;
    lock.ok_or_else(|| CheckpointError::InUse(folder.to_owned()))
}

/// The checkpoints in `folder`, oldest first, as (updates, path). A folder that does not exist has none.
pub fn list(folder: &Path) -> Result<Vec<(u64, PathBuf)>, CheckpointError> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(why) if why.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(why) => return Err(io_error("read", folder)(why)),
    };
    let mut all = Vec::new();
    for entry in entries {
        let path = entry.map_err(io_error("read", folder))?.path();
        let name = path.file_name().and_then(|name| name.to_str());
        let Some(rest) = name.and_then(|name| name.strip_prefix(PREFIX)) else {
            continue;
        };
        // A checkpoint that is being replaced counts until the new one has its name.
        let replaced = rest.strip_suffix(OLD_SUFFIX).map(|rest| {
            let is_replaced = folder.join(format!("{PREFIX}{rest}")).exists();
            (rest, is_replaced)
        });
        let (number, is_replaced) = replaced.unwrap_or((rest, false));
        match number.parse::<u64>() {
            Ok(updates) if !is_replaced => all.push((updates, path)),
            _ => {
                tracing::debug!(path = %path.display(), "left from an unfinished save; not a checkpoint")
            }
        }
    }
    all.sort();
    Ok(all)
}

/// Writes the checkpoint `folder/name`, which has these files.
///
/// They are written and flushed to disk in a staging folder, which is then renamed: a crash at any moment leaves the older checkpoints
/// whole and at most a `.tmp` folder, which the next call removes.
///
/// # Errors
/// A failing file system, such as a full disk. The older checkpoints are then kept, and nothing of the new one is left.
pub fn store(
    folder: &Path,
    name: &str,
    files: &[(impl AsRef<Path>, Vec<u8>)],
) -> Result<PathBuf, CheckpointError> {
    fs::create_dir_all(folder).map_err(io_error("create", folder))?;
    clean_up(folder)?;
    let (path, staging) = (folder.join(name), folder.join(format!("{name}.tmp")));
    let write = || {
        fs::create_dir(&staging).map_err(io_error("create", &staging))?;
        for (name, bytes) in files {
            write_durably(&staging.join(name), bytes)?;
        }
        sync(&staging)?;
        move_into_place(&staging, &path)
    };
    // An unfinished checkpoint would keep a full disk full.
    write().inspect_err(|_| remove_or_warn(&staging))?;
    Ok(path)
}

/// Calls `save`, and again after each `pause` for at most `retry_max` as long as it fails with an error that a person can remove while
/// the process waits, such as a full disk. Logs once what to do.
pub(crate) fn retry_until_writable(
    pause: Duration,
    retry_max: Duration,
    mut save: impl FnMut() -> Result<(), CheckpointError>,
) -> Result<(), CheckpointError> {
    let (started, mut is_logged) = (Instant::now(), false);
    loop {
        let (path, kind) = match save() {
            Err(CheckpointError::Io { path, why, .. })
                if is_removable(why.kind()) && started.elapsed() < retry_max =>
            {
                (path, why.kind())
            }
            saved => return saved,
        };
        if !std::mem::replace(&mut is_logged, true) {
            // Not in the system's words: the launcher shows few lines with these, and this line says why it waits.
            tracing::warn!(
                "the last checkpoint is not saved yet, as {} cannot be written ({kind}): make room or make it writable; retrying for {} min",
                path.display(),
                retry_max.as_secs() / 60
            );
        }
        sleep(pause);
    }
}

const fn is_removable(kind: ErrorKind) -> bool {
    matches!(
        kind,
        ErrorKind::StorageFull
            | ErrorKind::QuotaExceeded
            | ErrorKind::ReadOnlyFilesystem
            | ErrorKind::PermissionDenied
    )
}

/// Renames the checkpoint in `staging` to `path`. If `path` exists, as at a stop right after a periodic save, it is replaced: it
/// first moves to another name, under which [`list`] finds it between the two renames.
fn move_into_place(staging: &Path, path: &Path) -> Result<(), CheckpointError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let replaced = with_suffix(path, OLD_SUFFIX);
    if path.exists() {
        fs::rename(path, &replaced).map_err(io_error("move", path))?;
    }
    fs::rename(staging, path).map_err(io_error("move", staging))?;
    sync(folder)?;
    remove_or_warn(&replaced);
    Ok(())
}

/// Removes what interrupted saves have left, and gives a checkpoint whose replacement was interrupted its name back.
fn clean_up(folder: &Path) -> Result<(), CheckpointError> {
    for entry in fs::read_dir(folder).map_err(io_error("read", folder))? {
        let path = entry.map_err(io_error("read", folder))?.path();
        let name = path.file_name().and_then(|name| name.to_str());
        let Some(name) = name.filter(|it| it.starts_with(PREFIX) && it.ends_with(".tmp")) else {
            continue;
        };
        match name.strip_suffix(OLD_SUFFIX).map(|name| folder.join(name)) {
            Some(final_path) if !final_path.exists() => {
                fs::rename(&path, final_path).map_err(io_error("move", &path))?;
            }
            _ => {
                tracing::warn!(path = %path.display(), "removing what an unfinished save left");
                remove_or_warn(&path);
            }
        }
    }
    Ok(())
}

pub(super) fn read_file(folder: &Path, name: &str) -> Result<Vec<u8>, CheckpointError> {
    let path = folder.join(name);
    fs::read(&path).map_err(|why| match why.kind() {
        ErrorKind::NotFound => damaged(folder, name, "it is missing".to_owned()),
        _ => io_error("read", &path)(why),
    })
}

/// Writes a new file and flushes it to disk.
fn write_durably(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    File::create(path)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .map_err(io_error("write", path))
}

/// Flushes a folder's entries to disk.
fn sync(folder: &Path) -> Result<(), CheckpointError> {
    File::open(folder)
        .and_then(|folder| atomic_write::sync_folder(&folder))
        .map_err(io_error("flush", folder))
}

/// Renames a checkpoint and removes it: what an interrupted removal leaves must not look like a checkpoint.
pub fn prune(path: &Path) {
    let temporary = with_suffix(path, ".tmp");
    match fs::rename(path, &temporary) {
        Ok(()) => remove_or_warn(&temporary),
        Err(e) => tracing::warn!("an old checkpoint is left: {}", io_error("move", path)(e)),
    }
}

fn with_suffix(path: &Path, end: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(end);
    name.into()
}

/// Removes a folder, if it exists. A failure is only logged, as it does not affect what is saved.
fn remove_or_warn(folder: &Path) {
    match fs::remove_dir_all(folder) {
        Err(why) if why.kind() != ErrorKind::NotFound => {
            let why = io_error("remove", folder)(why);
            tracing::warn!("a checkpoint that is not needed was not removed: {why}");
        }
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_save_is_retried_while_a_person_can_remove_the_error() {
        for (kind, retry_s, tries) in [
            (ErrorKind::StorageFull, 60, 3),
            (ErrorKind::ReadOnlyFilesystem, 60, 3),
            (ErrorKind::StorageFull, 0, 1),
            (ErrorKind::NotFound, 60, 1),
        ] {
            let mut tried = 0;
            let saved = retry_until_writable(Duration::ZERO, Duration::from_secs(retry_s), || {
                tried += 1;
                match tried {
                    3 => Ok(()),
                    _ => Err(io_error("write", Path::new("x"))(kind.into())),
                }
            });
            assert_eq!((tried, saved.is_ok()), (tries, tries == 3), "{kind}");
        }
    }
}
