//! The settings of every preset as a snapshot, `tests/snapshots/presets.txt`, in which a changed number shows (`UPDATE_EXPECT=1` rewrites
//! it). Every number must have its source beside it. `chain` and `smoke` are left out, because their numbers are for tests.
//! A test of `menu` covers the games that `[[only]]` blocks name.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write,
};

use expect_test::expect_file;

use super::*;
use crate::{menu::comments, overrides::leaves};

const LEFT_OUT: [&str; 2] = ["world/chain", "variant/smoke"];

/// Words that name a source: the paper's appendix (Mazoure et al. 2020), the code that its authors published, others.
const SOURCES: &str =
    "paper, code, ours, tuned, et al., the engine's own, Procgen's default, PyTorch";

fn all_layers() -> BTreeMap<&'static str, Layer> {
    // The command of an external world is not a name; any command serves here.
    let exec = "exec:true".parse().unwrap();
    let worlds = WorldName::all().chain([exec]).map(world_layer);
    let named = AGENTS.iter().chain(PRESETS).copied();
    let all = worlds.chain(named).chain([BASE]);
    all.map(|layer| (layer.path, layer)).collect()
}

fn pinned() -> impl Iterator<Item = (&'static str, Layer)> {
    let all = all_layers().into_iter();
    all.filter(|(name, _)| !LEFT_OUT.contains(name))
}

#[test]
fn a_changed_number_shows_in_the_snapshot() {
    let mut text = String::new();
    for (name, layer) in pinned() {
        for (number, part) in layer.parts().iter().enumerate() {
            match number {
                0 => writeln!(text, "[{name}]").unwrap(),
                block => writeln!(text, "[{name}, only block {block}]").unwrap(),
            }
            for (path, value) in leaves(&part.set) {
                writeln!(text, "{path} = {value}").unwrap();
            }
        }
    }
    expect_file!["../../tests/snapshots/presets.txt"].assert_eq(&text);
}

#[test]
fn every_number_has_its_source_beside_it() {
    for (name, layer) in pinned() {
        for part in layer.parts() {
            let comments = comments(&part.text);
            for (path, value) in leaves(&part.set) {
                // A table on one line has one comment.
                let around = |known: &str| path == known || path.starts_with(&format!("{known}."));
                let comment = comments.iter().find(|(known, _)| around(known));
                let comment = comment.map_or("", |(_, comment)| comment);
                let is_named = SOURCES.split(", ").any(|it| comment.contains(it));
                let has_source = match value {
                    Value::Integer(0) => true,
                    Value::Float(number) if *number == 0.0 => true,
                    Value::Integer(_) | Value::Float(_) | Value::Array(_) => is_named,
                    Value::String(word) if word == "auto" => is_named,
                    // A format that is faster and less exact than f32 needs its measured price.
                    Value::String(word) if word.ends_with("f16") => comment.contains('%'),
                    _ => true,
                };
                let what = format!("{name}: {path} = {value} has the comment {comment:?}");
                let hint = "name one of SOURCES in it, and for f16 or bf16 a price in %";
                assert!(has_source, "{what}: {hint}");
            }
        }
    }
}

#[test]
fn a_run_without_a_preset_is_tuned_on_procgen_and_the_papers_elsewhere() {
    let of = |name| Choice::new(None, Some(name), None).unwrap().preset.name;
    let found = ["coinrun", "mspacman", "chain"].map(of);
    assert_eq!(found, ["tuned", "paper", "paper"]);
}

#[test]
fn every_layer_says_what_it_is_for_and_names_worlds_that_exist() {
    let worlds: BTreeSet<_> = WorldName::all().map(|world| world.to_string()).collect();
    for layer in all_layers().values() {
        assert!(layer.text.starts_with("# "), "{}", layer.path);
        for world in layer.parts().iter().flat_map(|part| &part.worlds) {
            assert!(worlds.contains(world), "{world} in {}", layer.path);
        }
    }
}
