//! Writes a file so that a crash at any moment leaves either the old file or the new one, whole.
//! The content is up to the caller.

use std::{
    fs::{File, Permissions},
    io::{self, ErrorKind, Write},
    os::unix::fs::PermissionsExt,
    path::Path,
};

/// Writes `bytes` to a temporary file beside `path`, flushes it to disk, renames it to `path` and flushes the folder. If a step up to the
/// renaming fails, the old file stays and the temporary one is removed. All users may read the file.
///
/// # Errors
/// The file system rejects an operation; the error names no path.
pub fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    // The temporary file is removed unless it is renamed.
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    file.write_all(bytes)?;
    // Temporary files are private by default.
    file.as_file()
        .set_permissions(Permissions::from_mode(0o644))?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|e| e.error)?;
    // Otherwise a crash of the machine may undo the renaming.
    sync_folder(&File::open(folder)?)
}

/// Flushes the entries of a folder to disk, if its file system can: those of some networks answer EINVAL.
///
/// # Errors
/// The disk cannot be written.
pub fn sync_folder(folder: &File) -> io::Result<()> {
    match folder.sync_all() {
        Err(e) if e.kind() == ErrorKind::InvalidInput => Ok(()),
        flushed => flushed,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_folder_that_cannot_be_flushed_is_no_error() {
        let folder = File::open("/proc").unwrap();
        let why = folder.sync_all().unwrap_err();
        assert_eq!(why.kind(), ErrorKind::InvalidInput);
        sync_folder(&folder).unwrap();
    }

    #[test]
    fn a_file_is_replaced_whole_or_not_at_all() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("summary.json");
        for text in ["one", "two"] {
            write(&path, text.as_bytes()).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        assert_eq!(
            fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o644
        );
        // A folder in its place cannot be replaced by a file.
        let taken = folder.path().join("taken");
        fs::create_dir(&taken).unwrap();
        assert!(write(&taken, b"three").is_err());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
        assert!(write(&folder.path().join("nowhere/file"), b"").is_err());
    }
}
