//! Installs the engine in the cache folder and finds it there.
//! It does not load the engine, and fetches nothing with `DRIML_OFFLINE=1`.
//!
//! Layout: `<cache>/procgen-0.10.7/{libenv.so, assets/, LICENSE}`. One process at a time makes the folder
//! beside its place, checks it and renames it: so the folder is complete or missing, and all processes that race succeed.

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::cache::{Cache, check_private};
use crate::error::ProcgenError;
use crate::library;
use crate::wheel::{self, LIBRARY_SHA256, WHEEL_NAME, WHEEL_SHA256};

/// The Python whose pip fetches and unpacks the engine.
const PYTHON: &str = "python3";

/// The names of folders in which the engine is unpacked begin with this.
const UNFINISHED: &str = "install-";

/// How old such a folder must be to be removed: a process that found no lock may still unpack into a younger one.
const UNFINISHED_AGE_MIN: Duration = Duration::from_secs(3600);

/// How long to wait for another process that installs; then this process installs too.
const LOCK_WAIT_MAX: Duration = Duration::from_secs(120);

/// The unpacked engine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Engine {
    library: PathBuf,
    assets: PathBuf,
}

impl Engine {
    /// Finds the engine in the cache folder.
    ///
    /// # Errors
    /// The engine is not installed or is incomplete, other users can change it, or this machine cannot run it.
    pub fn locate() -> Result<Engine, ProcgenError> {
        Engine::locate_in(&Cache::from_env()?)
    }

    /// Returns the engine in the cache folder, and fetches it with pip if it is not there.
    ///
    /// A wheel that already lies in the cache folder under its published name is used instead of fetching.
    /// `progress` gets a line for each step; none if the engine is installed.
    ///
    /// # Errors
    /// No pip, no network, a wrong hash, a full disk, `DRIML_OFFLINE=1`, or a machine that cannot run it.
    pub fn install(progress: &mut dyn FnMut(&str)) -> Result<Engine, ProcgenError> {
        let cache = Cache::from_env()?;
        let unpack = |to: &Path, provided: Option<&Path>| wheel::unpack(PYTHON, to, provided);
        Engine::install_in(&cache, LIBRARY_SHA256, progress, unpack)
    }

    /// Describes, for people, where [`Engine::install`] would take the engine from. Fetches nothing and checks no wheel.
    ///
    /// # Errors
    /// No pip, or `DRIML_OFFLINE=1` and no wheel in the cache folder.
    pub fn describe_source() -> Result<String, ProcgenError> {
        let cache = Cache::from_env()?;
        let provided = cache.provided_wheel("it is not installed")?;
        wheel::run_pip(PYTHON, &["--version"])?;
        Ok(provided.map_or_else(
            || "the package index with `python3 -m pip`".to_owned(),
            |wheel| wheel.display().to_string(),
        ))
    }

    /// Returns another build of the engine than the published one, by the path of its library. The pictures are in the
    /// folder `assets` beside the library or beside the library's folder, as in Procgen's own source tree. The library
    /// is code that runs as this user, and is loaded without a check of its hash.
    ///
    /// # Errors
    /// The library or the pictures are missing, or this machine cannot run the engine.
    pub fn from_library(library: &Path) -> Result<Engine, ProcgenError> {
        library::check_machine()?;
        // The loader would look for a name without a folder among the system's libraries.
        let invalid =
            |why: &str| ProcgenError::Options(format!("library = {}: {why}", library.display()));
        let library = fs::canonicalize(library)
            .map_err(|e| invalid(&format!("{e}; give the path of another build's libenv.so")))?;
        let mut folders = library.ancestors().skip(1).take(2);
        let assets =
            folders.find_map(|folder| Some(folder.join("assets")).filter(|it| it.is_dir()));
        let assets = assets.ok_or_else(|| {
            invalid("put Procgen's folder `assets` beside it or beside its folder")
        })?;
        Ok(Engine { library, assets })
    }

    /// Checks that the engine's library loads; makes no game.
    pub fn check_loads(&self) -> Result<(), ProcgenError> {
        library::load(&self.library).map(drop)
    }

    /// The engine's library.
    pub fn library(&self) -> &Path {
        &self.library
    }

    /// The folder of the pictures.
    pub fn assets(&self) -> &Path {
        &self.assets
    }

    fn locate_in(cache: &Cache) -> Result<Engine, ProcgenError> {
        library::check_machine()?;
        let root = cache.root();
        let engine = Engine {
            library: root.join("libenv.so"),
            assets: root.join("assets"),
        };
        let reason = if !root.exists() {
            "it is not installed"
        } else if !engine.library.is_file() || !engine.assets.is_dir() {
            "it is damaged: libenv.so or its pictures are missing"
        } else {
            for path in [&cache.folder, &root, &engine.library, &engine.assets] {
                check_private(path)?;
            }
            return Ok(engine);
        };
        Err(cache.missing_error(reason))
    }

    fn install_in(
        cache: &Cache,
        library_sha256: &str,
        progress: &mut dyn FnMut(&str),
        unpack: impl Fn(&Path, Option<&Path>) -> Result<(), ProcgenError>,
    ) -> Result<Engine, ProcgenError> {
        let reason = match Engine::locate_in(cache) {
            Err(ProcgenError::Missing { reason, .. }) => reason,
            other => return other,
        };
        let provided = cache.provided_wheel(&reason)?;
        check_private(&cache.folder)?;
        wheel::make_folder(&cache.folder)?;
        let lock = lock_install(cache, LOCK_WAIT_MAX);
        // Another process may have been faster.
        if let Ok(engine) = Engine::locate_in(cache) {
            return Ok(engine);
        }
        if lock.is_some() {
            remove_unfinished(&cache.folder, UNFINISHED_AGE_MIN);
        }
        let folder = tempfile::Builder::new()
            .prefix(UNFINISHED)
            .tempdir_in(&cache.folder)
            .map_err(ProcgenError::io("making a folder in", &cache.folder))?;
        let root = cache.root();
        let (fresh, target) = (folder.path().join("fresh"), root.display());
        if let Some(wheel) = &provided {
            let from = wheel.display();
            progress(&format!("procgen's engine: unpacking {from} into {target}"));
            wheel::check_hash(wheel, WHEEL_SHA256)?;
        } else {
            progress(&format!(
                "procgen's engine: {reason}; fetching it with pip (36 MB) into {target}"
            ));
        }
        unpack(&fresh, provided.is_some().then_some(&*cache.folder))?;
        wheel::check_hash(&fresh.join("libenv.so"), library_sha256)?;
        // A crash of the machine must not leave a folder in place whose files are empty.
        let _ = File::open(&fresh).map(nix::unistd::syncfs);
        // Another process may hold no lock either, as on file systems that have none: a whole engine may be in use, and stays.
        if let Ok(engine) = Engine::locate_in(cache) {
            return Ok(engine);
        }
        if root.exists() {
            // The temporary folder is deleted with all that is moved into it.
            fs::rename(&root, folder.path().join("damaged"))
                .map_err(ProcgenError::io("moving away the damaged", &root))?;
        }
        let renamed = fs::rename(&fresh, &root).map_err(ProcgenError::io("renaming", &root));
        // If files cannot be locked, another process may have installed the same meanwhile.
        Engine::locate_in(cache).map_err(|error| renamed.err().unwrap_or(error))
    }
}

impl Cache {
    fn root(&self) -> PathBuf {
        self.folder.join("procgen-0.10.7")
    }

    fn missing_error(&self, reason: &str) -> ProcgenError {
        ProcgenError::Missing {
            root: self.root(),
            reason: reason.to_owned(),
            fetch_command: wheel::fetch_command(),
        }
    }

    /// Returns the wheel that the user has put into the cache folder. Returns an error if it is missing and fetching is forbidden.
    fn provided_wheel(&self, reason: &str) -> Result<Option<PathBuf>, ProcgenError> {
        let provided = self.folder.join(WHEEL_NAME);
        if provided.is_file() {
            return Ok(Some(provided));
        }
        match self.offline {
            true => Err(self.missing_error(&format!(
                "{reason}, and DRIML_OFFLINE=1 forbids fetching it"
            ))),
            false => Ok(None),
        }
    }
}

/// Removes what installations left that were interrupted more than `age_min` ago. A folder that cannot be removed stays and does no harm.
fn remove_unfinished(folder: &Path, age_min: Duration) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let changed = entry.metadata().and_then(|it| it.modified());
        let age = changed.map(|it| it.elapsed().unwrap_or_default());
        let is_unfinished = entry.file_name().to_string_lossy().starts_with(UNFINISHED);
        if is_unfinished && age.is_ok_and(|age| age >= age_min) {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

/// Waits for the lock file, which one process holds at a time. Dropping the returned file releases it.
///
/// Returns `None` if the file cannot be locked or the limit has passed: then two processes may install at once, which
/// wastes time, and at worst one of them reports an error.
fn lock_install(cache: &Cache, limit: Duration) -> Option<File> {
    let file = File::create(cache.folder.join("install.lock")).ok()?;
    let started = Instant::now();
    loop {
        match file.try_lock() {
            Ok(()) => return Some(file),
            Err(TryLockError::WouldBlock) if started.elapsed() < limit => {
                std::thread::sleep(Duration::from_millis(50));
            }
            Err(_) => return None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::error::WITHOUT_ENGINE;

    /// The hash of the library that stands in for the engine's.
    const LIBRARY_HASH: &str = "8c08842bdcdbaa0dde9e6598c215af56513417ebd79c758c2cc8cd6a63f3f296";

    fn cache_in(folder: &Path) -> Cache {
        let folder = folder.join("cache");
        fs::create_dir_all(&folder).unwrap();
        let offline = false;
        Cache { folder, offline }
    }

    /// Installs with a stand-in for pip.
    fn install(cache: &Cache, library: &str) -> Result<Engine, ProcgenError> {
        let unpack = |to: &Path, _: Option<&Path>| {
            wheel::make_folder(&to.join("assets/b"))?;
            for file in ["libenv.so", "assets/b/c.png"] {
                fs::write(to.join(file), file).unwrap();
            }
            Ok(())
        };
        Engine::install_in(cache, library, &mut |_| {}, unpack)
    }

    /// The names of all that lies in the cache folder, except the wheel, sorted.
    fn file_names(cache: &Cache) -> Vec<String> {
        let entries = fs::read_dir(&cache.folder).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.filter(|name| name != WHEEL_NAME).collect();
        names.sort();
        names
    }

    #[test]
    fn installers_that_race_all_succeed_and_damage_is_repaired() {
        let folder = tempfile::tempdir().unwrap();
        let cache = cache_in(folder.path());
        // As an interrupted installation leaves it.
        wheel::make_folder(&cache.folder.join("install-x9/fresh")).unwrap();
        remove_unfinished(&cache.folder, UNFINISHED_AGE_MIN);
        assert_eq!(file_names(&cache), ["install-x9"]);
        remove_unfinished(&cache.folder, Duration::ZERO);
        for damaged in ["", "libenv.so", "assets"] {
            if !damaged.is_empty() {
                fs::rename(cache.root().join(damaged), folder.path().join(damaged)).unwrap();
                let error = Engine::locate_in(&cache).unwrap_err().to_string();
                assert!(error.contains("it is damaged"), "{error}");
            }
            std::thread::scope(|scope| {
                let install = || install(&cache, LIBRARY_HASH).unwrap();
                let threads: Vec<_> = (0..8).map(|_| scope.spawn(install)).collect();
                for thread in threads {
                    let engine = thread.join().unwrap();
                    assert!(engine.assets().join("b/c.png").is_file());
                }
            });
            assert_eq!(file_names(&cache), ["install.lock", "procgen-0.10.7"]);
        }
    }

    #[test]
    fn a_cache_that_others_can_change_is_rejected() {
        let folder = tempfile::tempdir().unwrap();
        let cache = cache_in(folder.path());
        let engine = install(&cache, LIBRARY_HASH).unwrap();
        for path in [
            &cache.folder,
            &cache.root(),
            engine.library(),
            engine.assets(),
        ] {
            let before = fs::metadata(path).unwrap().permissions();
            assert_eq!(before.mode() & 0o022, 0, "as unpacked: {}", path.display());
            let shared = fs::Permissions::from_mode(before.mode() | 0o020);
            fs::set_permissions(path, shared).unwrap();
            let error = install(&cache, LIBRARY_HASH).unwrap_err().to_string();
            let text = format!("others can change {}: ", path.display());
            assert!(error.contains(&text), "{error}");
            fs::set_permissions(path, before).unwrap();
        }
        // Nothing is put into a folder of others either.
        fs::remove_dir_all(cache.root()).unwrap();
        fs::set_permissions(&cache.folder, fs::Permissions::from_mode(0o777)).unwrap();
        assert!(matches!(
            install(&cache, LIBRARY_HASH),
            Err(ProcgenError::Cache(_))
        ));
    }

    #[test]
    fn what_cannot_be_had_is_said_with_what_to_do_and_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut cache = cache_in(folder.path());
        let unpack = |_: &Path, _: Option<&Path>| Err(ProcgenError::Fetch("no route".to_owned()));
        let says = |cache: &Cache, lines, words: &str| {
            let mut told = 0;
            let error = Engine::install_in(cache, LIBRARY_SHA256, &mut |_| told += 1, unpack);
            let text = error.unwrap_err().to_string();
            assert!(text.contains(words), "{text}");
            assert!(text.ends_with(WITHOUT_ENGINE) && told == lines, "{text}");
        };
        cache.offline = true;
        let forbidden = "it is not installed, and DRIML_OFFLINE=1 forbids";
        says(&cache, 0, forbidden);
        says(&cache, 0, "pip download procgen==0.10.7 --no-deps");
        cache.offline = false;
        says(&cache, 1, "fetching procgen's engine: no route");
        let error = install(&cache, LIBRARY_SHA256).unwrap_err().to_string();
        let text = format!("libenv.so: its SHA-256 is {LIBRARY_HASH}, expected {LIBRARY_SHA256}");
        assert!(error.contains(&text), "{error}");
        fs::write(cache.folder.join(WHEEL_NAME), b"no wheel").unwrap();
        says(&cache, 1, &format!("expected {WHEEL_SHA256}"));
        assert_eq!(file_names(&cache), ["install.lock"]);
        // A cache folder that cannot be written: a file is in its place.
        cache.folder = cache.folder.join("install.lock");
        says(&cache, 0, "installing procgen's engine: making ");
    }

    #[test]
    fn one_process_installs_and_the_others_wait_for_it() {
        let folder = tempfile::tempdir().unwrap();
        let cache = cache_in(folder.path());
        let lock = lock_install(&cache, Duration::ZERO);
        assert!(lock.is_some());
        assert!(lock_install(&cache, Duration::from_millis(120)).is_none());
        drop(lock);
        // A child that another test has just forked holds the lock until it runs its program.
        assert!(lock_install(&cache, Duration::from_secs(60)).is_some());
    }
}
