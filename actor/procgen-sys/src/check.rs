//! Whether an unpacked engine is the pinned one, byte for byte, and whether nobody else can change it.
//! The engine is C++ that runs in this process and reads the pictures: so all of it is looked at at each start.

use std::fs::{self, Metadata};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use nix::unistd::geteuid;
use sha2::{Digest, Sha256};

use crate::error::InstallError;
use crate::release::{ASSETS_SHA256, LIBENV_SHA256};
use crate::wheel;

/// The hashes that an engine has to have.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Hashes<'a> {
    /// SHA-256 of `libenv.so`.
    pub(crate) library: &'a str,
    /// SHA-256 over those of its pictures, as `hash_of` has it.
    pub(crate) assets: &'a str,
}

/// Those of the pinned wheel.
pub(crate) const PINNED: Hashes<'static> = Hashes {
    library: LIBENV_SHA256,
    assets: ASSETS_SHA256,
};

/// Checks that everything in `root` is as unpacked, and this user's or root's alone to change.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn check(root: &Path, hashes: Hashes<'_>) -> Result<(), InstallError> {
    let damaged = |reason: String| InstallError::Damaged {
        root: root.to_owned(),
        reason,
    };
    let unreadable = |path: &Path, e: io::Error| damaged(format!("{}: {e}", path.display()));
    check_private(root)?;
    let marker = root.join(MARKER);
    fs::metadata(&marker).map_err(|e| unreadable(&marker, e))?;
    let library = root.join("libenv.so");
    check_private(&library)?;
    let hash = wheel::sha256(&library).map_err(|e| unreadable(&library, e))?;
    if hash != hashes.library {
        return Err(damaged(
            "libenv.so has another SHA-256 than the pinned one".into(),
        ));
    }
    let assets = root.join("assets");
    let mut files = Vec::new();
    walk(&assets, "", &mut files)?;
    let hash = hash_of(&assets, files).map_err(|e| unreadable(&assets, e))?;
    if hash != hashes.assets {
        return Err(damaged("pictures are missing or changed".into()));
    }
    Ok(())
}

/// The file that is written last, so that an engine without it is known to be half unpacked.
pub(crate) const MARKER: &str = "installed.txt";

/// Checks that nobody but this user and root can change the file or folder; one that is not there can be changed by nobody.
///
/// # Errors
/// Who can, and what to do.
pub(crate) fn check_private(path: &Path) -> Result<(), InstallError> {
    match fs::metadata(path) {
        Ok(data) => judge(path, &data),
        Err(_) => Ok(()),
    }
}

fn judge(path: &Path, data: &Metadata) -> Result<(), InstallError> {
    let shared = |why: String| InstallError::Shared {
        path: path.to_owned(),
        why,
    };
    let owner = data.uid();
    if owner != 0 && owner != geteuid().as_raw() {
        return Err(shared(format!("it belongs to user {owner}")));
    }
    // In the group, or all others.
    if data.mode() & 0o022 != 0 {
        let mode = data.mode() & 0o777;
        return Err(shared(format!("its permissions are {mode:o}")));
    }
    Ok(())
}

/// Adds the path of every file below `folder`, which is called `name` in the list, and checks who can change it.
fn walk(folder: &Path, name: &str, files: &mut Vec<String>) -> Result<(), InstallError> {
    let reading = |e| InstallError::io("reading", folder, e);
    for entry in fs::read_dir(folder).map_err(reading)? {
        let entry = entry.map_err(reading)?;
        let data = entry.metadata().map_err(reading)?;
        judge(&entry.path(), &data)?;
        let name = format!("{name}{}", entry.file_name().to_string_lossy());
        if data.is_dir() {
            walk(&entry.path(), &format!("{name}/"), files)?;
        } else {
            files.push(name);
        }
    }
    Ok(())
}

/// SHA-256 over the hashes of all files below a folder: over the lines `HASH  PATH` that `sha256sum` would print, sorted by path.
fn hash_of(folder: &Path, mut files: Vec<String>) -> io::Result<String> {
    files.sort();
    let mut all = Sha256::new();
    for name in files {
        let bytes = fs::read(folder.join(&name))?;
        all.update(format!("{}  {name}\n", wheel::hex(&Sha256::digest(bytes))));
    }
    Ok(wheel::hex(&all.finalize()))
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn set_mode(path: &Path, mode: u32) {
        fs::set_permissions(path, Permissions::from_mode(mode)).unwrap();
    }

    #[test]
    fn what_others_can_change_is_refused_with_what_to_do() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        for mode in [0o700, 0o755, 0o555] {
            set_mode(path, mode);
            assert!(check_private(path).is_ok(), "{mode:o}");
        }
        for mode in [0o775, 0o757, 0o722] {
            set_mode(path, mode);
            let said = check_private(path).unwrap_err().to_string();
            let why = format!("its permissions are {mode:o}");
            assert!(
                said.contains(&why) && said.contains("chmod -R go-w"),
                "{said}"
            );
            assert!(said.contains("DRIML_CACHE"), "{said}");
        }
        set_mode(path, 0o700);
        assert!(check_private(&path.join("nothing")).is_ok());
    }

    #[test]
    fn what_belongs_to_others_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        if !geteuid().is_root() {
            // Only root can give a file away; what is root's is taken by everyone.
            assert!(check_private(Path::new("/usr")).is_ok());
            return;
        }
        std::os::unix::fs::chown(file.path(), Some(4711), None).unwrap();
        let said = check_private(file.path()).unwrap_err().to_string();
        assert!(said.contains("it belongs to user 4711"), "{said}");
    }

    #[test]
    fn a_folder_s_hash_is_of_names_and_contents() {
        let folder = tempfile::tempdir().unwrap();
        let hash = || {
            let mut files = Vec::new();
            walk(folder.path(), "", &mut files).unwrap();
            hash_of(folder.path(), files).unwrap()
        };
        let nothing = hash();
        fs::create_dir(folder.path().join("b")).unwrap();
        fs::write(folder.path().join("b/c"), "x").unwrap();
        fs::write(folder.path().join("a"), "y").unwrap();
        // `(cd FOLDER; sha256sum a b/c | sha256sum)`
        let first = hash();
        assert_eq!(
            first,
            "58a7ba15722425053e9ec1cdc41ee7b764ab71373413620eca8eb0865450d5b7"
        );
        fs::write(folder.path().join("a"), "z").unwrap();
        let changed = hash();
        fs::rename(folder.path().join("b/c"), folder.path().join("b/d")).unwrap();
        let renamed = hash();
        let all = [nothing, first, changed, renamed];
        assert!((0..4).all(|i| !all[i + 1..].contains(&all[i])), "{all:?}");
    }
}
