//! The experiments from end to end, in their smoke length: every file there, the same every time, resumed and refused.
//! What their numbers mean at full length is on the pages in `deploy/experiments/`.

#![allow(clippy::unwrap_used)]

use std::{
    collections::BTreeMap,
    fs,
    path::Path,
    process::{Command, Output},
};

fn driml(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_driml"))
        .args(args)
        .current_dir(folder)
        .env_remove("DRIML_LOG")
        .output()
        .unwrap()
}

fn run(folder: &Path, args: &[&str]) -> String {
    let output = driml(folder, args);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{args:?}: {stderr}");
    String::from_utf8(output.stdout).unwrap()
}

/// Every file of a folder but the page, which has the time it took.
fn data(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    let files = entries.filter(|entry| entry.file_type().unwrap().is_file());
    files
        .map(|entry| {
            let name = entry.file_name().into_string().unwrap();
            (name, fs::read(entry.path()).unwrap())
        })
        .filter(|(name, _)| name != "README.md")
        .collect()
}

fn check(name: &str, files: &[&str]) {
    let root = tempfile::tempdir().unwrap();
    let printed = run(root.path(), &["experiment", name, "--smoke"]);
    let folder = root.path().join("experiments").join(name);
    assert!(printed.ends_with("README.md\n"), "{printed}");
    let page = fs::read_to_string(folder.join("README.md")).unwrap();
    for part in [
        "smoke length",
        "**Claim.**",
        "**Command.** `driml experiment",
        "**Time.**",
        "**Expected.**",
        "**Got.**",
        "**Differences from the paper.**",
    ] {
        assert!(page.contains(part), "{part}\n{page}");
    }
    let first = data(&folder);
    assert_eq!(first.keys().collect::<Vec<_>>(), files, "{name}");
    for (file, bytes) in &first {
        assert!(bytes.len() > 50, "{file} is all but empty");
        assert!(!String::from_utf8_lossy(bytes).contains("NaN"), "{file}");
    }

    // Elsewhere: the same bytes. Again, with one piece lost: that one is made anew, to the same bytes.
    run(
        root.path(),
        &["experiment", name, "--smoke", "--out", "other"],
    );
    assert_eq!(data(&root.path().join("other")), first);
    let mut pieces: Vec<_> = fs::read_dir(folder.join("pieces"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| !path.ends_with("settings.json"))
        .collect();
    pieces.sort();
    fs::remove_file(&pieces[0]).unwrap();
    run(root.path(), &["experiment", name, "--smoke"]);
    assert_eq!(data(&folder), first);

    // More seeds are more pieces of the same grid; the full length is another grid.
    run(
        root.path(),
        &["experiment", name, "--smoke", "--seeds", "3"],
    );
    let refused = driml(root.path(), &["experiment", name]);
    let said = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(refused.status.code(), Some(64), "{said}");
    assert!(said.contains("made with other settings"), "{said}");
}

#[test]
fn random_walk() {
    check(
        "random-walk",
        &[
            "alpha.csv",
            "convergence.csv",
            "convergence.png",
            "convergence.svg",
            "curves.csv",
            "fig1.png",
            "fig1.svg",
            "ratio.csv",
        ],
    );
}

#[test]
fn ising() {
    check(
        "ising",
        &[
            "auc.csv",
            "fig2.png",
            "fig2.svg",
            "learning.png",
            "learning.svg",
            "loss.csv",
            "maps.csv",
        ],
    );
}

#[test]
fn an_experiment_that_is_not_there() {
    let root = tempfile::tempdir().unwrap();
    for args in [
        &["experiment"][..],
        &["experiment", "walk"],
        &["experiment", "ising", "--seeds", "0"],
    ] {
        assert_eq!(driml(root.path(), args).status.code(), Some(64), "{args:?}");
    }
    // A file where the folder should be.
    fs::write(root.path().join("file"), "").unwrap();
    let args = ["experiment", "random-walk", "--smoke", "--out", "file"];
    let output = driml(root.path(), &args);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("making file/pieces"), "{said}");
}
