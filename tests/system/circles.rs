//! The files of a crate must not depend on each other in a circle: no file names another that leads back to the first.
//! The test reads the tokens of the sources, including those inside macro calls, but does not expand macros.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use proc_macro2::{Delimiter, TokenStream, TokenTree};
use walkdir::WalkDir;

/// A module's path from the crate's root, whose own path is empty. A path found in code may also end in an item's name.
type ModulePath = Vec<String>;

/// A file, and another file that its code names.
type Reference = (PathBuf, PathBuf);

/// Returns the module path of a file, given its path in the crate's sources.
fn module_of(file: &Path) -> ModulePath {
    let names = file.with_extension("");
    let names = names.iter().map(|name| name.to_str().unwrap().to_owned());
    let mut module: ModulePath = names.collect();
    module.pop_if(|name| ["lib", "main", "mod"].contains(&name.as_str()));
    module
}

/// Returns which files of the crate with its sources in `folder` name which others. Each module is a file, except modules of tests.
fn references(folder: &Path) -> BTreeSet<Reference> {
    let mut sources = Vec::new();
    for entry in WalkDir::new(folder).sort_by_file_name() {
        let file = entry.unwrap().into_path();
        if file.extension().is_some_and(|it| it == "rs") {
            let module = module_of(file.strip_prefix(folder).unwrap());
            sources.push((module, file));
        }
    }
    let modules: BTreeSet<_> = sources.iter().map(|it| it.0.clone()).collect();
    let mut references = BTreeSet::new();
    for (module, file) in &sources {
        let tokens = fs::read_to_string(file).unwrap().parse::<TokenStream>();
        let tokens = tokens.unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let mut paths = Vec::new();
        collect_paths(&without_tests(tokens), &[], &mut paths);
        for path in paths {
            let is_child = |first: String| modules.contains(&[&module[..], &[first]].concat());
            let mut named = match path.first().map(String::as_str) {
                Some("crate") => vec![],
                Some("self" | "super") => module.clone(),
                Some(first) if is_child(first.to_owned()) => module.clone(),
                // The path does not lead into this crate.
                _ => continue,
            };
            for segment in path {
                match segment.as_str() {
                    "crate" | "self" => {}
                    "super" => drop(named.pop()),
                    _ => named.push(segment),
                }
            }
            while !modules.contains(&named) {
                named.pop().expect("the root is a module");
            }
            if named != *module {
                // If a package has `lib.rs` and `main.rs`, both are the root module: a path to the root names both.
                let named = sources.iter().filter(|it| it.0 == named);
                references.extend(named.map(|it| (file.clone(), it.1.clone())));
            }
        }
    }
    references
}

/// Returns the tokens without the items under `#[cfg(test)]`.
fn without_tests(tokens: TokenStream) -> Vec<TokenTree> {
    let mut kept = Vec::new();
    let mut tokens = tokens.into_iter();
    while let Some(token) = tokens.next() {
        let is_test = matches!(&token, TokenTree::Group(group)
            if group.stream().to_string().replace(' ', "") == "cfg(test)");
        if !is_test {
            kept.push(token);
            continue;
        }
        // Skip the item to its end.
        for token in tokens.by_ref() {
            match token {
                TokenTree::Punct(end) if end.as_char() == ';' => break,
                TokenTree::Group(body) if body.delimiter() == Delimiter::Brace => break,
                _ => {}
            }
        }
    }
    kept
}

/// Adds all paths in `tokens` to `found`. `before` is the prefix of paths inside the braces of a `use`.
fn collect_paths(tokens: &[TokenTree], before: &[String], found: &mut Vec<ModulePath>) {
    let mut rest = tokens;
    while let [first, after @ ..] = rest {
        rest = after;
        let word = match first {
            TokenTree::Ident(word) => word.to_string(),
            TokenTree::Group(group) => {
                collect_paths(&without_tests(group.stream()), &[], found);
                continue;
            }
            _ => continue,
        };
        if word == "as" && !before.is_empty() {
            // An alias of the path that was just added.
            rest = rest.get(1..).unwrap_or_default();
            continue;
        }
        let mut path = [before, &[word]].concat();
        let mut is_whole = path.len() > 1;
        while let [
            TokenTree::Punct(one),
            TokenTree::Punct(two),
            next,
            after @ ..,
        ] = rest
            && [one, two].iter().all(|it| it.as_char() == ':')
        {
            match next {
                TokenTree::Ident(word) => path.push(word.to_string()),
                TokenTree::Group(group) => {
                    collect_paths(&without_tests(group.stream()), &path, found);
                    path.clear();
                }
                // A glob import, or the `<` of type arguments.
                _ => {}
            }
            is_whole = true;
            rest = after;
        }
        if is_whole {
            found.push(path);
        }
    }
}

/// Returns the references in and between circles. Removes, round by round, those whose start none enters or whose end none leaves.
fn circles(mut references: BTreeSet<Reference>) -> BTreeSet<Reference> {
    loop {
        let (from, to): (BTreeSet<_>, BTreeSet<_>) = references.iter().cloned().unzip();
        let before = references.len();
        references.retain(|reference| to.contains(&reference.0) && from.contains(&reference.1));
        if references.len() == before {
            return references;
        }
    }
}

#[test]
fn no_files_of_a_crate_form_a_circle() {
    let root = super::repo_rules::root();
    let mut found = Vec::new();
    for folder in super::repo_rules::folders_of_crates() {
        let sources = root.join(folder).join("src");
        for (from, to) in circles(references(&sources)) {
            let short = |file: &Path| file.strip_prefix(&root).unwrap().display().to_string();
            found.push(format!("{} names {}", short(&from), short(&to)));
        }
    }
    let found = found.join("\n");
    assert_eq!(found, "", "put what both need into a third file");
}

/// A crate of four files in which `b` and `c` name each other, one within braces and the other within a macro. Only their tests name `a`.
const LIBRARY: &str = r#"
lib.rs: mod a; mod b; #[cfg(test)] mod tests; pub use a::f;
a.rs: use crate::b::g; pub fn f() { g() }
b/mod.rs: mod c; use self::{c::{h as k}}; pub const N: u32 = 1; pub fn g() { k() }
b/c.rs: #[cfg(test)] use crate::a::{f}; pub fn h() { println!("{}", super::N) } #[cfg(test)] fn t() { crate::a::f() } #[cfg(test)] mod tests { use crate::a::f; }"#;
/// A package whose program has a circle beside a library without one.
const PROGRAM: &str = "
lib.rs: pub fn f() {}
main.rs: mod d; pub fn e() { d::i() } fn main() {}
d.rs: pub fn i() { crate::e() }";

#[test]
fn a_circle_is_found() {
    for (files, circle) in [
        (LIBRARY, ["b/mod.rs", "b/c.rs"]),
        (PROGRAM, ["main.rs", "d.rs"]),
    ] {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("b")).unwrap();
        for (name, text) in files.lines().filter_map(|it| it.split_once(": ")) {
            fs::write(folder.path().join(name), text).unwrap();
        }
        let [one, other] = circle.map(|name| folder.path().join(name));
        let found = circles(references(folder.path()));
        let expected = [(one.clone(), other.clone()), (other, one)];
        assert_eq!(found, BTreeSet::from(expected));
    }
}
