//! Installing without a network: made-up wheels, races, damage, messages.
//! The real wheel is unpacked in `tests/engine.rs`.

use std::io::Write;

use super::*;
use crate::error::WITHOUT_ENGINE;

fn cache(folder: &Path, offline: bool) -> Cache {
    Cache {
        folder: folder.join("cache"),
        offline,
    }
}

/// SHA-256 of the made-up library, and of the made-up pictures: of what `sha256sum a.png b/c.png` prints.
const HASHES: Hashes<'static> = Hashes {
    library: "a2100e1d73fedddfd22587d2ef8b33dd37a9f6480032176d4e0c80b3923f48e1",
    assets: "2266d954cab8fca2911929fbd7f12a0b1e6bd8ce4efaff10e3abbf1ff1a29c57",
};

/// A wheel with a made-up engine, and its hash.
fn made_up(folder: &Path) -> (PathBuf, String) {
    let path = folder.join("made-up.whl");
    let mut writer = zip::ZipWriter::new(File::create(&path).unwrap());
    for name in [
        "procgen/data/prebuilt/libenv.so",
        "procgen/data/assets/a.png",
        "procgen/data/assets/b/c.png",
    ] {
        writer
            .start_file(name, zip::write::SimpleFileOptions::default())
            .unwrap();
        writer.write_all(name.as_bytes()).unwrap();
    }
    writer.finish().unwrap();
    let hash = wheel::sha256(&path).unwrap();
    (path, hash)
}

/// Names of what lies in the cache folder, sorted.
fn left(cache: &Cache) -> Vec<String> {
    let entries = fs::read_dir(&cache.folder).unwrap();
    let name =
        |entry: std::io::Result<fs::DirEntry>| entry.unwrap().file_name().into_string().unwrap();
    let mut names: Vec<String> = entries.map(name).collect();
    names.sort();
    names
}

#[test]
fn damage_is_recognised_and_repaired() {
    let folder = tempfile::tempdir().unwrap();
    let cache = cache(folder.path(), true);
    let (wheel, hash) = made_up(folder.path());
    let install = || Engine::unpack_into(&cache, &wheel, &hash, HASHES);
    let reason = |root: &Path| {
        Engine::whole(root.to_owned(), HASHES)
            .unwrap_err()
            .to_string()
    };

    let root = install().unwrap().root;
    assert_eq!(
        Engine::whole(root.clone(), HASHES).unwrap().library(),
        root.join("libenv.so")
    );
    fs::write(root.join("libenv.so"), "other").unwrap();
    assert!(
        reason(&root).contains("another SHA-256"),
        "{}",
        reason(&root)
    );
    install().unwrap();
    // As many bytes as before.
    for damage in [Some("procgen/data/assets/b/d.png"), None] {
        let picture = root.join("assets/b/c.png");
        match damage {
            Some(bytes) => fs::write(picture, bytes).unwrap(),
            None => fs::remove_file(picture).unwrap(),
        }
        let said = reason(&root);
        assert!(said.contains("pictures are missing or changed"), "{said}");
        install().unwrap();
    }
    fs::write(root.join("assets/more.png"), "").unwrap();
    let said = reason(&root);
    assert!(said.contains("pictures are missing or changed"), "{said}");
    install().unwrap();
    fs::remove_file(root.join("installed.txt")).unwrap();
    assert!(reason(&root).contains("installed.txt"), "{}", reason(&root));
    install().unwrap();
    assert_eq!(
        fs::read(root.join("assets/b/c.png")).unwrap(),
        b"procgen/data/assets/b/c.png"
    );
    assert_eq!(
        left(&cache),
        ["install.lock", "procgen-0.10.7"],
        "nothing temporary is left"
    );
}

#[test]
fn a_cache_that_others_can_change_is_refused() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let cache = cache(folder.path(), true);
    let (wheel, hash) = made_up(folder.path());
    let install = || Engine::unpack_into(&cache, &wheel, &hash, HASHES);
    let root = install().unwrap().root;
    let find = || {
        check::check_private(&cache.folder)?;
        Engine::whole(root.clone(), HASHES)
    };
    for path in [
        &cache.folder,
        &root,
        &root.join("libenv.so"),
        &root.join("assets/b"),
        &root.join("assets/b/c.png"),
    ] {
        let mode = fs::metadata(path).unwrap().permissions();
        assert_eq!(mode.mode() & 0o022, 0, "as unpacked: {}", path.display());
        let shared = fs::Permissions::from_mode(mode.mode() | 0o020);
        fs::set_permissions(path, shared).unwrap();
        let error = find().unwrap_err();
        let InstallError::Shared { path: found, .. } = &error else {
            panic!("{error}");
        };
        assert_eq!(found, path);
        fs::set_permissions(path, mode).unwrap();
    }
    assert!(find().is_ok());
    // Nothing is put into a folder of others either.
    fs::set_permissions(&cache.folder, fs::Permissions::from_mode(0o777)).unwrap();
    assert!(matches!(install(), Err(InstallError::Shared { .. })));
}

#[test]
fn installers_that_race_all_succeed() {
    let folder = tempfile::tempdir().unwrap();
    let cache = cache(folder.path(), true);
    let (wheel, hash) = made_up(folder.path());
    for damaged in [false, true] {
        if damaged {
            fs::remove_file(Engine::root_in(&cache).join("installed.txt")).unwrap();
        }
        std::thread::scope(|scope| {
            let install = || Engine::unpack_into(&cache, &wheel, &hash, HASHES).unwrap();
            let threads: Vec<_> = (0..8).map(|_| scope.spawn(install)).collect();
            for thread in threads {
                let engine = thread.join().unwrap();
                Engine::whole(engine.root, HASHES).unwrap();
            }
        });
        assert_eq!(
            left(&cache),
            ["install.lock", "procgen-0.10.7"],
            "nothing temporary is left"
        );
    }
}

#[test]
fn offline_says_what_to_do_and_fetches_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let cache = cache(folder.path(), true);
    let fetch = |_: &Path| -> Result<PathBuf, InstallError> { panic!("fetched") };
    let error = Engine::install_in(&cache, &mut |line| panic!("{line}"), fetch)
        .unwrap_err()
        .to_string();
    assert!(
        error.starts_with(
            "DRIML_OFFLINE=1 forbids fetching procgen's engine, and it is not installed"
        ),
        "{error}"
    );
    assert!(
        error.contains("pip download procgen==0.10.7 --no-deps"),
        "{error}"
    );
    assert!(error.ends_with(WITHOUT_ENGINE), "{error}");
    assert!(
        Engine::locate_in(&cache)
            .unwrap_err()
            .to_string()
            .contains("not installed")
    );
}

#[test]
fn a_provided_wheel_is_used_and_its_hash_checked() {
    let folder = tempfile::tempdir().unwrap();
    let cache = cache(folder.path(), true);
    fs::create_dir_all(&cache.folder).unwrap();
    let (wheel, hash) = made_up(folder.path());
    fs::copy(wheel, cache.folder.join(WHEEL_NAME)).unwrap();
    let fetch = |_: &Path| -> Result<PathBuf, InstallError> { panic!("fetched") };
    let mut lines = Vec::new();
    let error =
        Engine::install_in(&cache, &mut |line| lines.push(line.to_owned()), fetch).unwrap_err();
    assert!(
        matches!(&error, InstallError::WrongHash { actual, .. } if *actual == hash),
        "{error}"
    );
    assert!(
        error.to_string().contains(WHEEL_SHA256) && error.to_string().ends_with(WITHOUT_ENGINE),
        "{error}"
    );
    assert_eq!(lines.len(), 1);
}

#[test]
fn what_pip_said_is_passed_on() {
    let folder = tempfile::tempdir().unwrap();
    let cache = cache(folder.path(), false);
    let fetch = |_: &Path| {
        let (pip, status) = ("pip".to_owned(), "exit status: 1".to_owned());
        Err(InstallError::PipFailed {
            pip,
            status,
            output: "ERROR: no route".to_owned(),
        })
    };
    let error = Engine::install_in(&cache, &mut |_| {}, fetch)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("is the network reachable?") && error.contains("ERROR: no route"),
        "{error}"
    );
    for error in [InstallError::NoPip, InstallError::NoCacheFolder] {
        assert!(error.to_string().ends_with(WITHOUT_ENGINE), "{error}");
    }
    assert_eq!(left(&cache), ["fetch.lock"], "nothing temporary is left");
}

#[test]
fn one_process_fetches_and_the_others_wait_for_it() {
    let folder = tempfile::tempdir().unwrap();
    let cache = cache(folder.path(), false);
    fs::create_dir_all(&cache.folder).unwrap();
    let turn = wait_for_turn(&cache, "a.lock", Duration::ZERO);
    assert!(turn.is_some());
    assert!(wait_for_turn(&cache, "a.lock", Duration::from_millis(120)).is_none());
    drop(turn);
    assert!(wait_for_turn(&cache, "a.lock", Duration::ZERO).is_some());
}

#[test]
fn where_the_engine_would_come_from() {
    let folder = tempfile::tempdir().unwrap();
    let source = |offline, pip: Option<&str>| {
        let cache = cache(folder.path(), offline);
        Engine::source_in(&cache, || pip.map(str::to_owned))
    };
    assert!(source(false, Some("pip3")).unwrap().contains("`pip3`"));
    assert!(matches!(source(false, None), Err(InstallError::NoPip)));
    assert!(matches!(
        source(true, Some("pip")),
        Err(InstallError::Offline { .. })
    ));
    let wheel = cache(folder.path(), true).folder.join(WHEEL_NAME);
    fs::create_dir_all(wheel.parent().unwrap()).unwrap();
    fs::write(&wheel, "a wheel").unwrap();
    assert_eq!(source(true, None).unwrap(), wheel.display().to_string());
}
