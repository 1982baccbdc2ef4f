//! Loads `libenv.so` once per path and finds its functions.
//! It never unloads the library: the engine keeps threads and static data that would be left hanging.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use libloading::os::unix::{Library, RTLD_LOCAL, RTLD_NOW};

use crate::error::ProcgenError;
use crate::ffi::{
    GetState, GetTensortypes, HandleFn, LIBENV_VERSION, MakeFn, SetBuffers, SetState, VersionFn,
};

/// The engine's functions. They stay valid for the rest of the process.
pub(crate) struct Api {
    pub(crate) make: MakeFn,
    pub(crate) get_tensortypes: GetTensortypes,
    pub(crate) set_buffers: SetBuffers,
    pub(crate) observe: HandleFn,
    pub(crate) act: HandleFn,
    pub(crate) close: HandleFn,
    pub(crate) get_state: GetState,
    pub(crate) set_state: SetState,
}

const GLIB: &str = "libglib2.0-0` or, since Debian 13 and Ubuntu 24.04, `libglib2.0-0t64";

/// The libraries that the engine needs: file, Debian package, Fedora package.
const LIBRARIES: [(&str, &str, &str); 6] = [
    ("libglib-2.0.so.0", GLIB, "glib2"),
    ("libgthread-2.0.so.0", GLIB, "glib2"),
    ("libz.so.1", "zlib1g", "zlib-ng-compat"),
    ("libstdc++.so.6", "libstdc++6", "libstdc++"),
    ("libgcc_s.so.1", "libgcc-s1", "libgcc"),
    ("libpcre2-8.so.0", "libpcre2-8-0", "pcre2"),
];

/// Loads the library at `path`, or finds it already loaded.
pub(crate) fn load(path: &Path) -> Result<&'static Api, ProcgenError> {
    static LOADED: Mutex<BTreeMap<PathBuf, &'static Api>> = Mutex::new(BTreeMap::new());
    check_machine()?;
    let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(api) = loaded.get(path) {
        return Ok(api);
    }
    let api: &'static Api = Box::leak(Box::new(open_library(path)?));
    loaded.insert(path.to_owned(), api);
    Ok(api)
}

/// Returns an error unless the engine can run on this machine: Linux on x86-64 with AVX.
pub(crate) fn check_machine() -> Result<(), ProcgenError> {
    if !cfg!(all(target_os = "linux", target_arch = "x86_64")) {
        return Err(ProcgenError::Machine(format!(
            "it is built for Linux on x86-64, and this is {} on {}",
            std::env::consts::OS,
            std::env::consts::ARCH
        )));
    }
    #[cfg(target_arch = "x86_64")]
    if !std::is_x86_feature_detected!("avx") {
        return Err(ProcgenError::Machine(
            "it needs a processor with AVX, and this one has none".to_owned(),
        ));
    }
    Ok(())
}

fn open_library(path: &Path) -> Result<Api, ProcgenError> {
    // SAFETY: loading runs the library's initialisers, which are trusted. Either the library's hash was compared with
    // the pinned one at its installation, and only this user can change it since, or the user has named another build.
    let library = unsafe { Library::open(Some(path), RTLD_NOW | RTLD_LOCAL) };
    let library = library.map_err(|error| load_error(path, &error.to_string()))?;
    // SAFETY: the types are those of gym3's `libenv.h`, and the version is checked before any other function is called.
    let found = unsafe { find_functions(&library) };
    let (version, api) = found.map_err(|error| ProcgenError::library(path, error))?;
    // Keep it loaded for the rest of the process, so that the function pointers stay valid.
    std::mem::forget(library);
    // SAFETY: `libenv_version` takes nothing and returns a constant.
    match unsafe { version() } {
        LIBENV_VERSION => Ok(api),
        found => Err(ProcgenError::library(
            path,
            format!("its interface is version {found}, not {LIBENV_VERSION}"),
        )),
    }
}

/// # Safety
/// The library's functions have the types of `ffi`, and are called only while it is loaded.
unsafe fn find_functions(library: &Library) -> Result<(VersionFn, Api), libloading::Error> {
    // SAFETY: the caller vouches for the types.
    unsafe {
        let api = Api {
            make: *library.get(b"libenv_make\0")?,
            get_tensortypes: *library.get(b"libenv_get_tensortypes\0")?,
            set_buffers: *library.get(b"libenv_set_buffers\0")?,
            observe: *library.get(b"libenv_observe\0")?,
            act: *library.get(b"libenv_act\0")?,
            close: *library.get(b"libenv_close\0")?,
            get_state: *library.get(b"get_state\0")?,
            set_state: *library.get(b"set_state\0")?,
        };
        Ok((*library.get(b"libenv_version\0")?, api))
    }
}

/// Turns an error of `dlopen` into an error that says what to do.
fn load_error(path: &Path, text: &str) -> ProcgenError {
    let is_missing = |library: &str| text.contains(library) && text.contains("cannot open shared");
    let missing = LIBRARIES.iter().find(|(library, ..)| is_missing(library));
    let reason = if let Some((library, debian, fedora)) = missing {
        format!(
            "the system library {library} is missing; install it with `apt-get install {debian}` (Debian, Ubuntu) or `dnf install {fedora}` \
             (Fedora)"
        )
    } else if text.contains("GLIBC") && text.contains("not found") {
        format!(
            "this system's C or C++ library is too old, it needs glibc 2.17 and libstdc++ of gcc 4.6 or later; use a newer distribution; \
             the loader said: {text}"
        )
    } else {
        text.to_owned()
    };
    ProcgenError::library(path, reason)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::WITHOUT_ENGINE;

    #[test]
    fn what_the_loader_says_becomes_what_to_do() {
        let missing = "cannot open shared object file: No such file or directory";
        for (said, texts) in [
            (
                format!("libgthread-2.0.so.0: {missing}"),
                &[
                    "library libgthread-2.0.so.0 is missing",
                    "`apt-get install libglib2.0-0` or",
                    "`libglib2.0-0t64`",
                ][..],
            ),
            (
                format!("libz.so.1: {missing}"),
                &["`apt-get install zlib1g`"],
            ),
            (format!("libstdc++.so.6: {missing}"), &["libstdc++6"]),
            (
                "libc.so.6: version `GLIBC_2.17' not found (required by libenv.so)".to_owned(),
                &["too old", "GLIBC_2.17"],
            ),
            (
                "/cache/libenv.so: file too short".to_owned(),
                &["engine from /cache/libenv.so: ", "file too short"],
            ),
        ] {
            let text = load_error(Path::new("/cache/libenv.so"), &said).to_string();
            assert!(text.ends_with(WITHOUT_ENGINE), "{text}");
            assert!(texts.iter().all(|it| text.contains(it)), "{text}");
        }
    }

    #[test]
    fn a_file_that_is_not_a_library_is_an_error_with_the_loaders_words() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), b"not a library").unwrap();
        let text = load(file.path()).err().unwrap().to_string();
        assert!(
            text.contains("file too short") || text.contains("invalid ELF"),
            "{text}"
        );
        assert!(load(Path::new("/nowhere/libenv.so")).is_err());
    }
}
