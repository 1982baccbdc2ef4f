//! Generates reference pages of `deploy/docs`: the commands from clap, the settings from the commented presets.
//! A test fails if they are stale; `UPDATE_EXPECT=1` rewrites them. Another test parses every `driml` command of the pages with clap.

use std::{
    collections::BTreeMap,
    fmt::Write,
    fs,
    path::{Path, PathBuf},
};

use clap::{Arg, Command, CommandFactory, Parser};
use driml_settings::presets::{Layer, PRESETS};
use expect_test::expect_file;
use walkdir::WalkDir;

use crate::cli::{Cli, EXAMPLES};

const GENERATED: &str =
    "<!-- Generated: `UPDATE_EXPECT=1 cargo test -p driml --lib reference` rewrites this page. -->";

fn flag_entry(arg: &Arg) -> String {
    let takes_values = arg.get_action().takes_values();
    let value = match arg.get_value_names() {
        Some([name]) if takes_values => format!(" <{name}>"),
        _ => String::new(),
    };
    let name = match arg.get_long() {
        Some(long) => format!("--{long}{value}"),
        None => value.trim_start().to_owned(),
    };
    let help = arg.get_help().map(ToString::to_string).unwrap_or_default();
    let clause = first_clause(&help);
    let has_default = |text: &str| text.contains("[default");
    assert_eq!(has_default(clause), has_default(&help), "{help}");
    let mut help = clause.to_owned();
    let defaults = arg.get_default_values().iter();
    let defaults: Vec<_> = defaults.map(|it| it.to_string_lossy()).collect();
    if takes_values && !defaults.is_empty() {
        write!(help, " [default: {}]", defaults.join(", ")).unwrap();
    }
    let possible = arg.get_possible_values();
    let possible: Vec<_> = possible.iter().map(|it| it.get_name()).collect();
    if takes_values && !possible.is_empty() {
        write!(help, " [values: {}]", possible.join(", ")).unwrap();
    }
    format!("* `{name}`: {help}\n")
}

/// Returns the help up to its first full stop or semicolon; `--help` shows the rest.
fn first_clause(help: &str) -> &str {
    let ends = [". ", "; "].into_iter().filter_map(|it| help.find(it));
    ends.min().map_or(help, |end| &help[..end])
}

/// Collects every command that does something or has flags for its subcommands, with the words that call it.
fn collect_commands(command: &Command, name: &str, found: &mut Vec<(String, Command)>) {
    let has_flags = command.get_arguments().any(|it| !it.is_hide_set());
    if has_flags || !command.has_subcommands() {
        found.push((name.to_owned(), command.clone()));
    }
    for sub in command.get_subcommands() {
        collect_commands(sub, &format!("{name} {}", sub.get_name()), found);
    }
}

/// Returns the page of all commands. A flag that several commands have in the same words appears once.
fn commands() -> String {
    let mut found = Vec::new();
    collect_commands(&Cli::command(), "driml", &mut found);
    let mut uses = BTreeMap::<String, usize>::new();
    let arguments = found.iter().flat_map(|(_, it)| it.get_arguments());
    for arg in arguments.filter(|it| !it.is_hide_set()) {
        *uses.entry(flag_entry(arg)).or_default() += 1;
    }
    let is_shared = |arg: &Arg| arg.get_long().is_some() && uses[&flag_entry(arg)] > 1;

    let mut page = format!("# Commands\n\n{GENERATED}\n\n");
    page += "`driml COMMAND --help` says more about each flag.\n";
    for (name, command) in &found {
        let about = command.get_about().map(ToString::to_string).unwrap();
        let aliases: Vec<_> = command.get_visible_aliases().collect();
        let end = if about.ends_with('?') { "" } else { "." };
        write!(page, "\n## `{name}`\n\n{about}{end}").unwrap();
        if !aliases.is_empty() {
            write!(page, " Alias: `{}`.", aliases.join("`, `")).unwrap();
        }
        page += "\n\n";
        let shown = command.get_arguments().filter(|it| !it.is_hide_set());
        let (shared, own): (Vec<_>, Vec<_>) = shown.partition(|it| is_shared(it));
        for arg in own {
            page += &flag_entry(arg);
        }
        let flags: Vec<_> = shared.iter().filter_map(|it| it.get_long()).collect();
        if !flags.is_empty() {
            let flags = flags.join("`, `--");
            writeln!(page, "* [Shared](#shared-options): `--{flags}`").unwrap();
        }
    }
    page += "\n## Shared options\n\n";
    let mut shared: Vec<_> = uses.into_iter().filter(|(_, uses)| *uses > 1).collect();
    shared.retain(|(entry, _)| entry.starts_with("* `--"));
    for (entry, _) in shared {
        page += &entry;
    }
    page
}

pub(crate) fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn preset_names(folder: &str) -> Vec<String> {
    let folder = root().join("deploy/settings/presets").join(folder);
    let files = fs::read_dir(folder).unwrap().map(|it| it.unwrap().path());
    let names = files.map(|file| file.file_stem().unwrap().to_str().unwrap().to_owned());
    let mut names: Vec<_> = names.collect();
    names.sort();
    names
}

/// Returns the page of settings: the base preset in full, and links to the others.
fn settings() -> String {
    let base = root().join("deploy/settings/presets/base.toml");
    let mut page = format!("# Settings\n\n{GENERATED}\n\n");
    page += "Settings are layered: base, world, preset, agent, then the flags and `--set`. The result stands in the run's `config.toml`.\n\
        `driml presets --env bigfish --agent driml-fix` prints it with the source of every value.\n\n\
        ## Base\n\n```toml\n";
    page += &fs::read_to_string(base).unwrap();
    page += "```\n\n## Presets\n\n";
    let link = |folder: &str, name: &str| {
        format!("[`{name}`](../../../settings/presets/{folder}/{name}.toml)")
    };
    for Layer { name, about, .. } in PRESETS {
        writeln!(page, "* {}: {about}.", link("variant", name)).unwrap();
    }
    for (folder, title) in [("agent", "Agents"), ("world", "Worlds")] {
        let names = preset_names(folder).into_iter();
        let links: Vec<_> = names.map(|name| link(folder, &name)).collect();
        write!(page, "\n## {title}\n\n{}\n", links.join(", ")).unwrap();
    }
    page
}

#[test]
fn the_generated_pages_are_up_to_date() {
    let folder = root().join("deploy/docs/src/reference");
    for (name, page) in [("commands.md", commands()), ("settings.md", settings())] {
        expect_file![folder.join(name)].assert_eq(&page);
    }
}

/// The words of a shell's line, without its comment and redirection.
fn split_words(line: &str) -> Vec<String> {
    let words = shlex::split(line).unwrap().into_iter();
    words.take_while(|it| !it.starts_with('>')).collect()
}

/// The lines of a page's shell blocks that call the program.
fn program_calls(page: &str) -> impl Iterator<Item = &str> {
    let blocks = page.split("```sh\n").skip(1);
    let lines = blocks.flat_map(|it| it.split("```").next().unwrap().lines());
    lines.filter(|it| it.starts_with("driml "))
}

#[test]
fn every_command_in_the_pages_and_every_example_parses() {
    let files = WalkDir::new(root().join("deploy/docs/src")).into_iter();
    let files = files.map(|entry| entry.unwrap().into_path());
    let pages = files.filter(|path| path.extension().is_some_and(|it| it == "md"));
    let pages = pages.chain([root().join("README.md")]);
    let pages = pages.map(|path| fs::read_to_string(path).unwrap());
    let examples = EXAMPLES.replace("Examples:", "```sh").replace("\n  ", "\n");
    assert_eq!(program_calls(&examples).count(), 3);
    let mut num_calls = 0;
    for page in pages.chain([examples]) {
        for call in program_calls(&page) {
            if let Err(e) = Cli::try_parse_from(split_words(call)) {
                panic!("{call}\n{e}");
            }
            num_calls += 1;
        }
    }
    assert!(num_calls > 50, "only {num_calls} commands were found");
}
