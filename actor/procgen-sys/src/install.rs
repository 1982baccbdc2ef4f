//! Puts the engine into the cache folder and knows whether it lies there whole.
//! It does not load it, and fetches nothing with `DRIML_OFFLINE=1`.
//!
//! Layout: `<cache>/procgen-0.10.7/{libenv.so, assets/, LICENSE, installed.txt}`; `installed.txt` is written last. What makes it
//! whole is for `check`.
//! A folder is made beside its place and renamed into it, one process at a time, so that all that race succeed.

use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::cache::Cache;
use crate::check::{self, Hashes, MARKER, PINNED};
use crate::error::{InstallError, LoadError};
use crate::library;
use crate::release::{VERSION, WHEEL_NAME, WHEEL_SHA256};
use crate::wheel;

/// How long to wait for another process that fetches or installs; then this one does it for itself.
const WAIT_MAX: Duration = Duration::from_secs(120);

/// The unpacked engine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Engine {
    root: PathBuf,
    library: PathBuf,
    assets: PathBuf,
}

impl Engine {
    /// The engine in the cache folder, if it lies there whole.
    ///
    /// # Errors
    /// Not installed, damaged, or a machine that cannot run it.
    pub fn locate() -> Result<Engine, InstallError> {
        Engine::locate_in(&Cache::from_env()?)
    }

    /// The engine in the cache folder; fetched with pip if it is missing or damaged.
    ///
    /// A wheel that already lies in the cache folder under its published name is used instead of fetching.
    /// `progress` is told what is being done, a line at a time; nothing when all is there.
    ///
    /// # Errors
    /// No pip, no network, a wrong hash, a full disk, `DRIML_OFFLINE=1`, or a machine that cannot run it.
    pub fn install(progress: &mut dyn FnMut(&str)) -> Result<Engine, InstallError> {
        Engine::install_in(&Cache::from_env()?, progress, wheel::fetch)
    }

    /// From where [`Engine::install`] would take the engine, for a person. Nothing is fetched or looked at more closely.
    ///
    /// # Errors
    /// No pip, or `DRIML_OFFLINE=1` and no wheel in the cache folder.
    pub fn source() -> Result<String, InstallError> {
        Engine::source_in(&Cache::from_env()?, wheel::find_pip)
    }

    /// Loads the engine's library, which makes no game yet.
    ///
    /// # Errors
    /// A library of the system that is missing, or anything else that the loader says.
    pub fn check_loads(&self) -> Result<(), LoadError> {
        library::load(&self.library()).map(drop)
    }

    /// Unpacks a wheel that the user has fetched; what lay in the cache folder is replaced unless it is whole.
    ///
    /// # Errors
    /// A wrong hash, an unreadable file, a full disk, or a machine that cannot run it.
    pub fn install_from_wheel(wheel: &Path) -> Result<Engine, InstallError> {
        library::check_machine()?;
        Engine::unpack_into(&Cache::from_env()?, wheel, WHEEL_SHA256, PINNED)
    }

    /// Another build of the engine than the published one, by the path of its library. Its pictures are in the folder `assets`
    /// beside the library or beside the library's folder, as in Procgen's own source tree. It is code that runs as this user: it is
    /// loaded as it is, whoever made it.
    ///
    /// # Errors
    /// A library or pictures that are not there, or a machine that cannot run it.
    pub fn other(library: &Path) -> Result<Engine, InstallError> {
        library::check_machine()?;
        // The loader takes a name without a folder for one of the system's.
        let library = fs::canonicalize(library).map_err(|error| InstallError::NoLibrary {
            library: library.to_owned(),
            reason: error.to_string(),
        })?;
        let folders = library.ancestors().skip(1).take(2);
        let assets = folders
            .map(|folder| folder.join("assets"))
            .find(|assets| assets.is_dir());
        let root = library.parent().unwrap_or(&library).to_owned();
        match assets {
            Some(assets) => Ok(Engine {
                root,
                library,
                assets,
            }),
            None => Err(InstallError::NoAssets { library }),
        }
    }

    /// The folder that holds everything.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The engine's library.
    pub fn library(&self) -> PathBuf {
        self.library.clone()
    }

    /// The folder of the pictures.
    pub fn assets(&self) -> PathBuf {
        self.assets.clone()
    }

    /// The engine that is unpacked in `root`.
    fn unpacked_in(root: PathBuf) -> Engine {
        Engine {
            library: root.join("libenv.so"),
            assets: root.join("assets"),
            root,
        }
    }

    fn root_in(cache: &Cache) -> PathBuf {
        cache.folder.join(format!("procgen-{VERSION}"))
    }

    fn locate_in(cache: &Cache) -> Result<Engine, InstallError> {
        library::check_machine()?;
        check::check_private(&cache.folder)?;
        Engine::whole(Engine::root_in(cache), PINNED)
    }

    fn source_in(
        cache: &Cache,
        pip: impl FnOnce() -> Option<String>,
    ) -> Result<String, InstallError> {
        let provided = cache.folder.join(WHEEL_NAME);
        if provided.is_file() {
            return Ok(provided.display().to_string());
        }
        if cache.offline {
            return Err(InstallError::Offline {
                root: Engine::root_in(cache),
                reason: "it is not installed".to_owned(),
            });
        }
        let pip = pip().ok_or(InstallError::NoPip)?;
        Ok(format!("the package index with `{pip}`"))
    }

    fn install_in(
        cache: &Cache,
        progress: &mut dyn FnMut(&str),
        fetch: impl Fn(&Path) -> Result<PathBuf, InstallError>,
    ) -> Result<Engine, InstallError> {
        let reason = match Engine::locate_in(cache) {
            Ok(engine) => return Ok(engine),
            Err(InstallError::Missing { .. }) => "it is not installed".to_owned(),
            Err(InstallError::Damaged { reason, .. }) => {
                format!("the installed one is damaged ({reason})")
            }
            Err(other) => return Err(other),
        };
        let root = Engine::root_in(cache);
        let provided = cache.folder.join(WHEEL_NAME);
        if provided.is_file() {
            progress(&format!(
                "procgen's engine: unpacking {} into {}",
                provided.display(),
                root.display()
            ));
            return Engine::unpack_into(cache, &provided, WHEEL_SHA256, PINNED);
        }
        if cache.offline {
            return Err(InstallError::Offline { root, reason });
        }
        wheel::make_folder(&cache.folder)?;
        let _turn = wait_for_turn(cache, "fetch.lock", WAIT_MAX);
        if let Ok(engine) = Engine::locate_in(cache) {
            return Ok(engine);
        }
        progress(&format!(
            "procgen's engine: {reason}; fetching version {VERSION} with pip (36 MB)"
        ));
        let folder = tempfile::Builder::new()
            .prefix("fetch-")
            .tempdir_in(&cache.folder);
        let folder =
            folder.map_err(|error| InstallError::io("making a folder in", &cache.folder, error))?;
        let wheel = fetch(folder.path())?;
        progress(&format!(
            "procgen's engine: unpacking into {}",
            root.display()
        ));
        Engine::unpack_into(cache, &wheel, WHEEL_SHA256, PINNED)
    }

    /// Checks and unpacks the wheel beside its place, then renames it into it.
    fn unpack_into(
        cache: &Cache,
        wheel: &Path,
        wheel_hash: &str,
        hashes: Hashes<'_>,
    ) -> Result<Engine, InstallError> {
        check::check_private(&cache.folder)?;
        wheel::check_hash(wheel, wheel_hash)?;
        wheel::make_folder(&cache.folder)?;
        let folder = tempfile::Builder::new()
            .prefix("unpack-")
            .tempdir_in(&cache.folder);
        let folder =
            folder.map_err(|error| InstallError::io("making a folder in", &cache.folder, error))?;
        let fresh = folder.path().join("fresh");
        wheel::make_folder(&fresh)?;
        wheel::unpack(wheel, &fresh)?;
        let text = format!("procgen {VERSION} from {WHEEL_NAME}\n");
        wheel::write(&mut text.as_bytes(), &fresh.join(MARKER))
            .map_err(|error| InstallError::io("writing", &fresh, error))?;

        let root = Engine::root_in(cache);
        let _turn = wait_for_turn(cache, "install.lock", WAIT_MAX);
        if let Ok(engine) = Engine::whole(root.clone(), hashes) {
            return Ok(engine);
        }
        if root.exists() {
            // What is moved into the temporary folder goes with it.
            fs::rename(&root, folder.path().join("damaged"))
                .map_err(|error| InstallError::io("moving away the damaged", &root, error))?;
        }
        match fs::rename(&fresh, &root) {
            Ok(()) => Engine::whole(root, hashes),
            // Where files cannot be locked, somebody may have been faster: theirs is as good, if it is whole.
            Err(error) => Engine::whole(root.clone(), hashes)
                .map_err(|_| InstallError::io("renaming into place", &root, error)),
        }
    }

    /// The engine in `root`, if it is whole and nobody else can change it.
    fn whole(root: PathBuf, hashes: Hashes<'_>) -> Result<Engine, InstallError> {
        if !root.exists() {
            return Err(InstallError::Missing { root });
        }
        check::check(&root, hashes)?;
        Ok(Engine::unpacked_in(root))
    }
}

/// Lets one process at a time do something, by locking a file; the turn ends when what this gives is dropped.
///
/// `None` when the file cannot be locked or the limit has passed: then two may do the same at once, which wastes
/// time, and at worst one of them reports an error.
fn wait_for_turn(cache: &Cache, name: &str, limit: Duration) -> Option<File> {
    let file = File::create(cache.folder.join(name)).ok()?;
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
mod tests;
