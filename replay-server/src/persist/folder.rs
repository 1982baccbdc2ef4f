//! The folder of a log: one server alone uses it, and it says whose replay is in it.
//! What the segments hold is for `recover`.

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use driml_protocol::{lock_file, whole_file};

use super::{
    error::PersistError,
    segment::{self, FORMAT, LogId, SegmentFile},
};

/// The file that says which log it is.
const ID: &str = "log.toml";

/// A folder that is in use by this process.
pub(super) struct LogFolder {
    pub(super) path: PathBuf,
    _lock: File,
}

/// Makes an error of the file system one that says what was done with which file.
pub(super) fn io_error(
    doing: &'static str,
    path: &Path,
) -> impl FnOnce(io::Error) -> PersistError + use<> {
    let path = path.to_owned();
    move |source| PersistError::Io {
        doing,
        path,
        source,
    }
}

impl LogFolder {
    /// Makes the folder if it is not there, and keeps other servers out of it.
    pub(super) fn open(path: &Path) -> Result<Self, PersistError> {
        fs::create_dir_all(path).map_err(io_error("making", path))?;
        let lock = path.join(".lock");
        let lock = lock_file::create(&lock, "start no other replay server there")
            .map_err(io_error("locking", &lock))?
            .ok_or_else(|| PersistError::InUse(path.to_owned()))?;
        Ok(Self {
            path: path.to_owned(),
            _lock: lock,
        })
    }

    /// All segments in the folder, by number.
    pub(super) fn segments(&self) -> Result<Vec<SegmentFile>, PersistError> {
        segment::list(&self.path).map_err(io_error("listing", &self.path))
    }

    /// Which log is in the folder; none if it is a new one.
    pub(super) fn read_id(&self) -> Result<Option<LogId>, PersistError> {
        let path = self.path.join(ID);
        let text = match fs::read_to_string(&path) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            read => read.map_err(io_error("reading", &path))?,
        };
        toml::from_str(&text).map(Some).map_err(|e| {
            let why = format!("cannot be read: {}", e.message());
            PersistError::Unusable(path, why)
        })
    }

    /// Says which log is in the folder.
    pub(super) fn write_id(&self, id: &LogId) -> Result<(), PersistError> {
        let path = self.path.join(ID);
        let text = toml::to_string(id).expect("a struct of numbers is TOML");
        let text =
            format!("# The replay that a replay server of driml keeps in this folder.\n{text}");
        whole_file::write(&path, text.as_bytes()).map_err(io_error("writing", &path))
    }

    /// Checks that `found` is the log of the run and shard of `ours`.
    pub(super) fn check(&self, found: &LogId, ours: &LogId) -> Result<(), PersistError> {
        let unusable = |why| Err(PersistError::Unusable(self.path.clone(), why));
        if found.format != FORMAT {
            return unusable(format!(
                "holds a replay of format {}, this version reads {FORMAT}: choose another --replay-dir",
                found.format
            ));
        }
        let why = if found.shard != ours.shard {
            format!(
                "shard {} of {}; this is shard {} of {}",
                found.shard.0, found.shard.1, ours.shard.0, ours.shard.1
            )
        } else if found.spec_hash != ours.spec_hash {
            let (theirs, ours) = (found.spec_hash, ours.spec_hash);
            format!("its run spec has the hash {theirs:016x}, this run's {ours:016x}")
        } else {
            return Ok(());
        };
        unusable(format!(
            "holds the replay of another run ({why}): use that run's settings, or choose another --replay-dir"
        ))
    }
}
