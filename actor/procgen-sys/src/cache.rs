//! Where what is fetched is kept, as the environment says.
//! It only computes paths; `install` makes and checks what lies there, `deploy/cuda/build.sh` follows the same rule.

use std::ffi::OsString;
use std::path::PathBuf;

use crate::error::InstallError;

/// The cache folder and whether fetching is allowed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cache {
    /// The folder under which each version of the engine has its own.
    pub folder: PathBuf,
    /// Whether nothing may be fetched (`DRIML_OFFLINE=1`).
    pub offline: bool,
}

impl Cache {
    /// As this process's environment says.
    ///
    /// # Errors
    /// No variable says where it is.
    pub fn from_env() -> Result<Cache, InstallError> {
        Cache::from_variables(|name| std::env::var_os(name))
    }

    /// `DRIML_CACHE`, else `$XDG_CACHE_HOME/driml`, else `$HOME/.cache/driml`. Empty counts as not set.
    fn from_variables(get: impl Fn(&str) -> Option<OsString>) -> Result<Cache, InstallError> {
        let set = |name: &str| get(name).filter(|value| !value.is_empty());
        let folder = if let Some(folder) = set("DRIML_CACHE") {
            PathBuf::from(folder)
        } else if let Some(folder) = set("XDG_CACHE_HOME") {
            PathBuf::from(folder).join("driml")
        } else {
            let home = set("HOME").ok_or(InstallError::NoCacheFolder)?;
            PathBuf::from(home).join(".cache").join("driml")
        };
        let offline = set("DRIML_OFFLINE").is_some_and(|value| value != "0");
        Ok(Cache { folder, offline })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cache(variables: &[(&str, &str)]) -> Result<Cache, InstallError> {
        Cache::from_variables(|name| {
            variables
                .iter()
                .find(|(key, _)| *key == name)
                .map(|(_, value)| value.into())
        })
    }

    #[test]
    fn the_nearest_variable_decides() {
        let folder = |variables: &[(&str, &str)]| cache(variables).unwrap().folder;
        assert_eq!(folder(&[("HOME", "/h")]), PathBuf::from("/h/.cache/driml"));
        assert_eq!(
            folder(&[("HOME", "/h"), ("XDG_CACHE_HOME", "/x")]),
            PathBuf::from("/x/driml")
        );
        assert_eq!(
            folder(&[
                ("HOME", "/h"),
                ("XDG_CACHE_HOME", "/x"),
                ("DRIML_CACHE", "/d")
            ]),
            PathBuf::from("/d")
        );
        assert_eq!(
            folder(&[("HOME", "/h"), ("DRIML_CACHE", "")]),
            PathBuf::from("/h/.cache/driml")
        );
        assert!(cache(&[]).unwrap_err().to_string().contains("DRIML_CACHE"));
    }

    #[test]
    fn offline_is_one_and_not_zero() {
        assert!(!cache(&[("HOME", "/h")]).unwrap().offline);
        assert!(
            !cache(&[("HOME", "/h"), ("DRIML_OFFLINE", "0")])
                .unwrap()
                .offline
        );
        assert!(
            cache(&[("HOME", "/h"), ("DRIML_OFFLINE", "1")])
                .unwrap()
                .offline
        );
    }
}
