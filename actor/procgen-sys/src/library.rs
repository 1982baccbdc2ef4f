//! Loads `libenv.so` once per path and finds its functions.
//! It never unloads it: the engine keeps threads and static data that would be left hanging.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};

use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};

use crate::error::LoadError;
use crate::ffi::{
    self, GetState, GetTensortypes, LIBENV_VERSION, Make, SetBuffers, SetState, Unit, Version,
};

/// The engine's functions. They stay valid for the rest of the process.
pub(crate) struct Api {
    pub(crate) make: Make,
    pub(crate) get_tensortypes: GetTensortypes,
    pub(crate) set_buffers: SetBuffers,
    pub(crate) observe: Unit,
    pub(crate) act: Unit,
    pub(crate) close: Unit,
    pub(crate) get_state: GetState,
    pub(crate) set_state: SetState,
}

/// The packages that hold the libraries which the engine needs: file, Debian, Fedora.
const PACKAGES: [(&str, &str, &str); 6] = [
    (
        "libglib-2.0.so.0",
        "libglib2.0-0` or, since Debian 13 and Ubuntu 24.04, `libglib2.0-0t64",
        "glib2",
    ),
    (
        "libgthread-2.0.so.0",
        "libglib2.0-0` or, since Debian 13 and Ubuntu 24.04, `libglib2.0-0t64",
        "glib2",
    ),
    ("libz.so.1", "zlib1g", "zlib-ng-compat"),
    ("libstdc++.so.6", "libstdc++6", "libstdc++"),
    ("libgcc_s.so.1", "libgcc-s1", "libgcc"),
    ("libpcre2-8.so.0", "libpcre2-8-0", "pcre2"),
];

/// Loads the library at `path`, or finds it already loaded.
pub(crate) fn load(path: &Path) -> Result<&'static Api, LoadError> {
    static LOADED: OnceLock<Mutex<BTreeMap<PathBuf, &'static Api>>> = OnceLock::new();
    check_machine()?;
    let loaded = LOADED.get_or_init(Mutex::default);
    let mut loaded = loaded.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(api) = loaded.get(path) {
        return Ok(api);
    }
    let api: &'static Api = Box::leak(Box::new(open(path)?));
    loaded.insert(path.to_owned(), api);
    Ok(api)
}

/// Says whether the engine can run on this machine.
///
/// # Errors
/// Not Linux on x86-64, or a processor without AVX.
pub(crate) fn check_machine() -> Result<(), LoadError> {
    if !cfg!(all(target_os = "linux", target_arch = "x86_64")) {
        return Err(LoadError::Machine(format!(
            "it is built for Linux on x86-64, and this is {} on {}",
            std::env::consts::OS,
            std::env::consts::ARCH
        )));
    }
    #[cfg(target_arch = "x86_64")]
    if !std::is_x86_feature_detected!("avx") {
        return Err(LoadError::Machine(
            "it needs a processor with AVX, and this one has none".to_owned(),
        ));
    }
    Ok(())
}

fn open(path: &Path) -> Result<Api, LoadError> {
    // SAFETY: running the library's initialisers is what loading means; either `check` compared its hash with
    // the pinned one just before, or a person has named another build.
    let library = unsafe { Library::open(Some(path), RTLD_NOW | RTLD_LOCAL) };
    let library = library.map_err(|error| explain(path, &error.to_string()))?;
    let missing = |error: libloading::Error| LoadError::Other {
        path: path.to_owned(),
        reason: error.to_string(),
    };
    // SAFETY: the types are those of gym3's `libenv.h`, and the version is checked before any other function is called.
    let (version, api) = unsafe {
        let version = *library
            .get::<Version>(b"libenv_version\0")
            .map_err(missing)?;
        let api = Api {
            make: *library.get(b"libenv_make\0").map_err(missing)?,
            get_tensortypes: *library.get(b"libenv_get_tensortypes\0").map_err(missing)?,
            set_buffers: *library.get(b"libenv_set_buffers\0").map_err(missing)?,
            observe: *library.get(b"libenv_observe\0").map_err(missing)?,
            act: *library.get(b"libenv_act\0").map_err(missing)?,
            close: *library.get(b"libenv_close\0").map_err(missing)?,
            get_state: *library.get(b"get_state\0").map_err(missing)?,
            set_state: *library.get(b"set_state\0").map_err(missing)?,
        };
        (version, api)
    };
    // Keep it loaded for the rest of the process, so that the function pointers stay valid.
    std::mem::forget(library);
    // SAFETY: `libenv_version` takes nothing and returns a constant.
    let found = unsafe { version() };
    if found != LIBENV_VERSION {
        let reason = format!(
            "its interface is version {found}, not {}",
            ffi::LIBENV_VERSION
        );
        return Err(LoadError::Other {
            path: path.to_owned(),
            reason,
        });
    }
    Ok(api)
}

/// Turns what `dlopen` said into what to do about it.
fn explain(path: &Path, said: &str) -> LoadError {
    let missing = PACKAGES
        .iter()
        .find(|(library, ..)| said.contains(library) && said.contains("cannot open shared"));
    if let Some(&(library, debian, fedora)) = missing {
        return LoadError::MissingLibrary {
            library: library.to_owned(),
            debian,
            fedora,
        };
    }
    if said.contains("GLIBC") && said.contains("not found") {
        return LoadError::TooOld(said.to_owned());
    }
    LoadError::Other {
        path: path.to_owned(),
        reason: said.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::WITHOUT_ENGINE;

    #[test]
    fn what_the_loader_says_becomes_what_to_do() {
        let path = Path::new("/cache/libenv.so");
        let said = |text: &str| explain(path, text).to_string();
        let text =
            said("libgthread-2.0.so.0: cannot open shared object file: No such file or directory");
        assert!(text.contains("libgthread-2.0.so.0 is missing"), "{text}");
        assert!(text.contains("`apt-get install libglib2.0-0` or"), "{text}");
        assert!(text.contains("`libglib2.0-0t64`"), "{text}");
        let text = said("libz.so.1: cannot open shared object file: No such file or directory");
        assert!(text.contains("`apt-get install zlib1g`"), "{text}");
        let text =
            said("libstdc++.so.6: cannot open shared object file: No such file or directory");
        assert!(text.contains("libstdc++6"), "{text}");
        let text = said(
            "/lib/x86_64-linux-gnu/libc.so.6: version `GLIBC_2.17' not found (required by libenv.so)",
        );
        assert!(
            text.contains("too old") && text.contains("GLIBC_2.17"),
            "{text}"
        );
        let text = said("/cache/libenv.so: file too short");
        assert!(
            text.contains("file too short") && text.ends_with(WITHOUT_ENGINE),
            "{text}"
        );
    }

    #[test]
    fn a_file_that_is_no_library_is_an_error_with_the_loaders_words() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), b"not a library").unwrap();
        let error = load(file.path()).err().unwrap().to_string();
        assert!(error.contains("loading procgen's engine"), "{error}");
        assert!(
            error.contains("file too short") || error.contains("invalid ELF"),
            "{error}"
        );
        assert!(load(Path::new("/nowhere/libenv.so")).is_err());
    }
}
