//! The cache folder: finds it by the environment variables, and checks that other users cannot change what lies in it.
//! It creates nothing; `install` does. `deploy/cuda/build.sh` follows the same rule for the folder.

use std::ffi::OsString;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::unistd::geteuid;

use crate::error::ProcgenError;

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Cache {
    /// The folder under which each version of the engine has its own.
    pub(crate) folder: PathBuf,
    /// Whether nothing may be fetched (`DRIML_OFFLINE=1`).
    pub(crate) offline: bool,
}

impl Cache {
    /// Reads the environment variables of this process.
    pub(crate) fn from_env() -> Result<Cache, ProcgenError> {
        Cache::from_variables(|name| std::env::var_os(name))
    }

    /// `DRIML_CACHE`, else `$XDG_CACHE_HOME/driml`, else `$HOME/.cache/driml`. Empty counts as not set.
    fn from_variables(get: impl Fn(&str) -> Option<OsString>) -> Result<Cache, ProcgenError> {
        let value_of = |name: &str| get(name).filter(|value| !value.is_empty());
        let below = |name: &str, path: &str| value_of(name).map(|it| PathBuf::from(it).join(path));
        let folder = value_of("DRIML_CACHE")
            .map(PathBuf::from)
            .or_else(|| below("XDG_CACHE_HOME", "driml"))
            .or_else(|| below("HOME", ".cache/driml"));
        let no_folder = "there is no folder for it: set DRIML_CACHE, XDG_CACHE_HOME or HOME";
        Ok(Cache {
            folder: folder.ok_or_else(|| ProcgenError::Cache(no_folder.to_owned()))?,
            offline: value_of("DRIML_OFFLINE").is_some_and(|value| value != "0"),
        })
    }
}

/// Checks that only this user and root can change the file or folder, as the engine runs as this user. A missing path passes.
pub(crate) fn check_private(path: &Path) -> Result<(), ProcgenError> {
    let Ok(metadata) = fs::metadata(path) else {
        return Ok(());
    };
    let why = if metadata.uid() != 0 && metadata.uid() != geteuid().as_raw() {
        format!("it belongs to user {}", metadata.uid())
    } else if metadata.mode() & 0o022 != 0 {
        format!("its permissions are {:o}", metadata.mode() & 0o777)
    } else {
        return Ok(());
    };
    let path = path.display();
    Err(ProcgenError::Cache(format!(
        "it is code that would run as you, and others can change {path}: {why}. Make it yours alone (`chown -R \"$(id -u)\" {path}` as \
         root, `chmod -R go-w {path}`), or set DRIML_CACHE to another folder"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_variable_decides() {
        let cache = |variables: &[(&str, &str)]| {
            Cache::from_variables(|name| {
                let found = variables.iter().find(|(key, _)| *key == name);
                found.map(|(_, value)| value.into())
            })
        };
        let (home, xdg) = (("HOME", "/h"), ("XDG_CACHE_HOME", "/x"));
        for (variables, folder, offline) in [
            (&[home][..], "/h/.cache/driml", false),
            (&[home, xdg], "/x/driml", false),
            (&[home, xdg, ("DRIML_CACHE", "/d")], "/d", false),
            (&[home, ("DRIML_CACHE", "")], "/h/.cache/driml", false),
            (&[home, ("DRIML_OFFLINE", "0")], "/h/.cache/driml", false),
            (&[home, ("DRIML_OFFLINE", "1")], "/h/.cache/driml", true),
        ] {
            let found = cache(variables).unwrap();
            assert_eq!((found.folder, found.offline), (folder.into(), offline));
        }
        assert!(cache(&[]).unwrap_err().to_string().contains("DRIML_CACHE"));
    }

    #[test]
    fn what_others_can_change_is_rejected_with_what_to_do() {
        use std::os::unix::fs::{PermissionsExt, chown};
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        for mode in [0o700, 0o755, 0o555, 0o775, 0o757, 0o722] {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
            match check_private(path) {
                Ok(()) => assert_eq!(mode & 0o022, 0, "{mode:o}"),
                Err(error) => {
                    assert_ne!(mode & 0o022, 0, "{mode:o}");
                    let text = error.to_string();
                    assert!(text.contains(&format!("are {mode:o}. Make")), "{text}");
                    assert!(text.contains("chmod -R go-w"), "{text}");
                }
            }
        }
        fs::set_permissions(path, fs::Permissions::from_mode(0o700)).unwrap();
        assert!(check_private(&path.join("nothing")).is_ok());
        assert!(check_private(Path::new("/usr")).is_ok(), "root's");
        // Only root can give a file away.
        if geteuid().is_root() {
            chown(path, Some(4711), None).unwrap();
            let text = check_private(path).unwrap_err().to_string();
            assert!(text.contains("it belongs to user 4711"), "{text}");
        }
    }
}
