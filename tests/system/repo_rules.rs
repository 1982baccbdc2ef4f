//! Rules of the repository that the compiler does not check: which crate may depend on which, and what may be where.
//! The tests build nothing and need no network. They read the graph of crates from `Cargo.lock`.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use walkdir::{DirEntry, WalkDir};

/// The most lines of Rust in each top-level folder, with tests. A change that adds code removes as much, or its commit says what it adds.
const LINES_MAX: [(&str, usize); 6] = [
    ("protocol", 7_420),
    ("actor", 10_490),
    ("replay-server", 11_130),
    ("learner", 21_700),
    ("deploy", 31_250),
    ("tests", 10_265),
];
const FILE_LINES_MAX: usize = 450;

/// Each of our packages, its folder, and those of our packages that it may depend on; * for all. Dependencies of tests and benches count.
const DEPENDENCIES: &str = "
driml-protocol      protocol            :
procgen-sys         actor/procgen-sys   :
driml-envs          actor/envs          : procgen-sys
driml-model         learner/model       :
driml-actor         actor               : driml-protocol driml-envs driml-model
driml-replay-server replay-server       : driml-protocol
driml-learner       learner             : driml-protocol driml-model
driml-figure        deploy/figure       :
driml-machine       deploy/machine      : driml-protocol driml-model procgen-sys
driml-settings      deploy/settings     : driml-protocol driml-envs driml-model driml-actor driml-replay-server driml-learner \
                                          driml-machine
driml-launch        deploy/launch       : driml-protocol driml-envs driml-model driml-actor driml-replay-server driml-learner \
                                          driml-machine driml-settings driml-figure
driml-experiments   deploy/experiments  : driml-protocol driml-envs driml-model driml-actor driml-replay-server driml-learner \
                                          driml-machine driml-settings driml-figure driml-launch procgen-sys
driml-bench         deploy/bench        : driml-protocol driml-envs driml-model driml-actor driml-replay-server driml-learner \
                                          driml-machine driml-settings driml-launch procgen-sys
driml               deploy              : *
driml-examples      deploy/examples     : driml driml-envs driml-learner driml-model driml-tests
driml-tests         tests               : *
driml-decoders      tests/decoders      : driml-protocol driml-actor driml-replay-server driml-learner driml-settings
";

/// Returns the lines of [`DEPENDENCIES`]: name, folder, and the packages that it may depend on.
fn allowed_dependencies() -> impl Iterator<Item = (&'static str, &'static str, Vec<&'static str>)> {
    DEPENDENCIES.trim().lines().map(|line| {
        let (package, known) = line
            .split_once(':')
            .expect("a package and what it may know");
        let mut words = package.split_whitespace();
        let mut word = || words.next().expect("a name and a folder");
        (word(), word(), known.split_whitespace().collect())
    })
}

pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("this package lies in the workspace")
        .into()
}

pub(crate) fn folders_of_crates() -> impl Iterator<Item = &'static str> {
    allowed_dependencies().map(|(_, folder, _)| folder)
}

/// Returns the text of a file, by its path from the root.
pub(crate) fn read(path: impl AsRef<Path>) -> String {
    fs::read_to_string(root().join(path)).unwrap()
}

/// Reads a TOML file, by its path from the root.
fn read_toml(path: impl AsRef<Path>) -> toml::Table {
    read(path).parse().unwrap()
}

/// Returns the dependencies of each package in `Cargo.lock`, on any platform, with tests and benches. Versions of a package are merged.
fn locked_dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let mut packages = BTreeMap::<_, BTreeSet<_>>::new();
    for package in read_toml("Cargo.lock")["package"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap().to_owned();
        let dependencies = package.get("dependencies").into_iter();
        // "name", or "name version" where there are several.
        let names = dependencies.flat_map(|it| it.as_array().unwrap());
        let names = names.map(|it| it.as_str().unwrap().split(' ').next().unwrap().to_owned());
        packages.entry(name).or_default().extend(names);
    }
    packages
}

#[test]
fn arrows_between_crates_point_one_way() {
    let workspace = read_toml("Cargo.toml");
    let members = workspace["workspace"]["members"].as_array().unwrap();
    let members: BTreeSet<_> = members.iter().map(|it| it.as_str().unwrap()).collect();
    assert_eq!(
        members,
        folders_of_crates().collect(),
        "a new package needs a line in DEPENDENCIES, and a reason"
    );
    let ours: BTreeSet<_> = allowed_dependencies().map(|(name, ..)| name).collect();
    let locked = locked_dependencies();
    for (name, _, allowed) in allowed_dependencies() {
        for dependency in &locked[name] {
            let dependency = dependency.as_str();
            assert!(
                !ours.contains(dependency) || allowed == ["*"] || allowed.contains(&dependency),
                "{name} may not know {dependency}"
            );
        }
    }
}

/// Returns everything that `package` depends on, directly or indirectly.
fn all_dependencies(package: &str) -> BTreeSet<String> {
    let locked = locked_dependencies();
    let mut seen = BTreeSet::new();
    let mut next = vec![package];
    while let Some(name) = next.pop() {
        if seen.insert(name.to_owned()) {
            next.extend(locked[name].iter().map(String::as_str));
        }
    }
    seen
}

/// A package, and names that none of its dependencies may have: a whole name, or the part before a dash.
const FORBIDDEN_DEPENDENCIES: &str = "
driml-replay-server : candle gemm safetensors rayon
driml-model         : zenoh tokio bincode
driml-envs          : zenoh tokio candle gemm
procgen-sys         : zenoh tokio candle
";

#[test]
fn each_process_is_free_of_what_is_none_of_its_business() {
    for line in FORBIDDEN_DEPENDENCIES.trim().lines() {
        let (package, foreign) = line.split_once(" : ").expect("a package and names");
        let tree = all_dependencies(package.trim());
        for name in foreign.split(' ') {
            let is_it = |it: &&String| *it == name || it.starts_with(&format!("{name}-"));
            let found = tree.iter().find(is_it);
            assert_eq!(found, None, "{package} has {name} in its tree");
        }
    }
    // Check the spelling of the names: the learner has these dependencies.
    let learner = all_dependencies("driml-learner");
    for name in "candle-core gemm safetensors rayon zenoh tokio bincode".split(' ') {
        assert!(learner.contains(name), "{name}");
    }
}

/// Returns the path from the root of every file of the repository that is not built, downloaded or left by a run.
fn repo_files() -> Vec<String> {
    let root = root();
    let name = |entry: &DirEntry| {
        let name = entry.path().strip_prefix(&root).unwrap();
        name.to_str().expect("names here are plain").to_owned()
    };
    // `target` and `runs` are in .gitignore; a folder that cargo made contains CACHEDIR.TAG.
    let is_ours = |entry: &DirEntry| {
        !matches!(&*name(entry), ".git" | "target" | "runs")
            && !entry.path().join("CACHEDIR.TAG").exists()
    };
    let walk = WalkDir::new(&root).into_iter().filter_entry(is_ours);
    let all = walk.map(|entry| entry.unwrap());
    let files = all.filter(|entry| !entry.file_type().is_dir());
    let mut files: Vec<_> = files.map(|entry| name(&entry)).collect();
    files.sort();
    assert!(files.len() > 300, "the walk found only {files:?}");
    files
}

pub(crate) struct Source {
    /// The path from the root.
    pub(crate) name: String,
    pub(crate) text: String,
}

/// Returns the files whose names end in one of `endings`.
pub(crate) fn sources(endings: &[&str]) -> Vec<Source> {
    let mut names = repo_files();
    names.retain(|name| endings.iter().any(|it| name.ends_with(it)));
    let source = |name: String| Source {
        text: read(&name),
        name,
    };
    names.into_iter().map(source).collect()
}

/// Returns the identifiers in a Rust file outside its comments. Strings count as code, which errs on the strict side.
fn identifiers(text: &str) -> BTreeSet<&str> {
    let code = text
        .lines()
        .map(|line| line.split("//").next().unwrap_or_default());
    code.flat_map(|code| code.split(|c: char| !(c.is_alphanumeric() || c == '_')))
        .collect()
}

#[test]
fn every_source_file_says_what_it_is_for_and_no_script_follows_cdpath() {
    for Source { name, text } in sources(&[".rs"]) {
        let first = text.lines().next().unwrap_or_default();
        let is_text = first.starts_with("//! ") && first.len() > 12;
        assert!(is_text, "{name} starts with {first:?}");
    }
    for Source { name, text } in sources(&[".sh", ".ci/run"]) {
        let is_at_home = text.contains("\nunset CDPATH\n");
        assert!(is_at_home, "{name} follows CDPATH");
    }
}

#[test]
fn the_code_stays_within_its_budget() {
    let files = sources(&[".rs"]);
    for (folder, lines_max) in LINES_MAX {
        let inside = files
            .iter()
            .filter(|it| Path::new(&it.name).starts_with(folder));
        let lines: usize = inside.map(|it| it.text.lines().count()).sum();
        let hint = "cut lines, or raise LINES_MAX and say in the commit what they add";
        let is_within = (1..=lines_max).contains(&lines);
        assert!(is_within, "{folder}: {lines} of {lines_max}; {hint}");
    }
    for Source { name, text } in &files {
        let lines = text.lines().count();
        assert!(lines <= FILE_LINES_MAX, "split {name}: {lines} lines");
    }
}

#[test]
fn dangerous_words_stay_where_they_are_needed() {
    let ffi = &["actor/procgen-sys/", "learner/model/src/kernels/isa/"];
    // The messages, and the saved state of worlds.
    let encoded = &["protocol/src/wire/", "actor/envs/src/saved.rs"];
    let caught = &["replay-server/tests/", "tests/decoders/tests/"];
    let rules: [(&str, &[&str]); 4] = [
        ("unsafe", ffi),
        ("unsafe_code", ffi),
        ("bincode", encoded),
        // A panic ends the process: no code of the program may rely on catching one.
        ("catch_unwind", caught),
    ];
    for (word, places) in rules {
        let mut uses = 0;
        for Source { name, text } in sources(&[".rs"]) {
            // This file has to name them.
            if name != "tests/system/repo_rules.rs" && identifiers(&text).contains(word) {
                let is_place = places.iter().any(|place| name.starts_with(place));
                assert!(is_place, "{name} uses `{word}`");
                uses += 1;
            }
        }
        assert!(uses > 0, "no file uses `{word}`: is it needed?");
    }
}

#[test]
fn comments_and_messages_say_who_does_what() {
    // Put together here, because this file is checked, too.
    let vague = ["no_body", "some_body", "every_body", "who_ever"].map(|it| it.replace('_', ""));
    for Source { name, text } in sources(&[".rs"]) {
        let text = text.to_lowercase();
        let found = vague.iter().find(|it| text.contains(*it));
        assert_eq!(found, None, "{name}: name the process or person");
    }
}

#[test]
fn nothing_points_at_the_machine_it_was_written_on() {
    // Put together here, because this file is checked, too.
    let places = ["work", "root"].map(|folder| format!("/{folder}/"));
    for name in repo_files() {
        // Binary files, such as parity cases, hold no paths.
        let Ok(text) = fs::read_to_string(root().join(&name)) else {
            continue;
        };
        for (number, line) in text.lines().enumerate() {
            let found = places.iter().find(|place| points_at(line, place));
            assert_eq!(found, None, "{name}:{}: {line}", number + 1);
        }
    }
}

/// Returns whether `place` starts an absolute path in `line`, rather than standing inside a longer path or an address.
fn points_at(line: &str, place: &str) -> bool {
    line.match_indices(place).any(|(at, _)| {
        let before = line[..at].chars().next_back();
        before.is_none_or(|c| !(c.is_alphanumeric() || "._-~}*".contains(c)))
    })
}

#[test]
fn every_package_takes_the_workspace_s_lints_and_versions() {
    for (name, folder, _) in allowed_dependencies() {
        let manifest = read_toml(Path::new(folder).join("Cargo.toml"));
        assert_eq!(manifest["package"]["name"].as_str(), Some(name), "{folder}");
        let lints = manifest["lints"]["workspace"].as_bool();
        assert_eq!(lints, Some(true), "{folder}");
        for kind in ["dependencies", "dev-dependencies", "build-dependencies"] {
            let Some(table) = manifest.get(kind).and_then(toml::Value::as_table) else {
                continue;
            };
            for (name, dependency) in table {
                let taken = dependency.get("workspace").and_then(toml::Value::as_bool);
                assert_eq!(taken, Some(true), "{folder}: version of {name}");
            }
        }
    }
}
