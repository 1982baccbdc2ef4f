//! No files of a crate form a circle: each can be read knowing only those that it names, and they never lead back to it.
//! It reads the sources' tokens, those within macros' brackets too; it does not know what the compiler makes of macros' results.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use proc_macro2::{Delimiter, TokenStream, TokenTree};

/// A module's path from the crate's root, which is empty itself.
type ModulePath = Vec<String>;

/// The files of one crate, and which names which.
struct Crate {
    /// Of each module, its file. Modules within a file are in it too.
    files: BTreeMap<ModulePath, PathBuf>,
    /// Of each file, what its code names: a path from the crate's root, which ends in an item's name or in a module's.
    named: BTreeMap<PathBuf, BTreeSet<ModulePath>>,
}

impl Crate {
    /// Reads the crate whose sources lie in `folder`.
    fn read(folder: &Path) -> Self {
        let mut read = Self {
            files: BTreeMap::new(),
            named: BTreeMap::new(),
        };
        for root in ["lib.rs", "main.rs"].map(|name| folder.join(name)) {
            if root.exists() {
                read.read_file(&root, &[], folder);
            }
        }
        read
    }

    /// Reads a module's file; files of its children lie in `folder`.
    fn read_file(&mut self, file: &Path, module: &[String], folder: &Path) {
        let text = fs::read_to_string(file).unwrap();
        let tokens = text.parse::<TokenStream>();
        let tokens = tokens.unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        self.read_module(tokens, file, module, folder);
    }

    fn read_module(&mut self, tokens: TokenStream, file: &Path, module: &[String], folder: &Path) {
        // That a program's root is its library's too changes nothing.
        let files = self.files.entry(module.to_vec());
        files.or_insert_with(|| file.into());
        let tokens = without_tests(tokens);
        let (mut own, mut children) = (Vec::new(), BTreeMap::new());
        let mut rest = &tokens[..];
        while let [first, after @ ..] = rest {
            rest = after;
            if let [TokenTree::Ident(name), body, after @ ..] = rest
                && matches!(first, TokenTree::Ident(word) if word == "mod")
            {
                children.insert(name.to_string(), body.clone());
                rest = after;
            } else {
                own.push(first.clone());
            }
        }
        let named = self.named.entry(file.into()).or_default();
        let mut written = Vec::new();
        note_paths(&own, &[], &mut written);
        for path in written {
            let mut from = match path.first().map(String::as_str) {
                Some("crate") => vec![],
                Some("self" | "super") => module.to_vec(),
                Some(first) if children.contains_key(first) => module.to_vec(),
                // It does not lead into this crate.
                _ => continue,
            };
            for segment in &path {
                match segment.as_str() {
                    "crate" | "self" => {}
                    "super" => drop(from.pop()),
                    name => from.push(name.into()),
                }
            }
            named.insert(from);
        }
        for (name, body) in children {
            let path = [module, std::slice::from_ref(&name)].concat();
            let inner = folder.join(&name);
            if let TokenTree::Group(body) = body {
                self.read_module(body.stream(), file, &path, &inner);
                continue;
            }
            let flat = folder.join(format!("{name}.rs"));
            let found = if flat.exists() {
                flat
            } else {
                inner.join("mod.rs")
            };
            self.read_file(&found, &path, &inner);
        }
    }

    /// The file in which `path` leads to an item, or to a module.
    fn file_of(&self, path: &[String]) -> &Path {
        let module = (0..=path.len())
            .rev()
            .find_map(|n| self.files.get(&path[..n]));
        module.expect("the root is a module")
    }

    /// The files that each file names.
    fn arrows(&self) -> BTreeMap<&Path, BTreeSet<&Path>> {
        let arrows = self.named.iter().map(|(file, named)| {
            let named = named.iter().map(|path| self.file_of(path));
            (file.as_path(), named.filter(|to| *to != file).collect())
        });
        arrows.collect()
    }
}

/// Tokens without the items that are compiled for tests alone.
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
        // The item goes to its end.
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

/// Notes all paths as code has them; `before` is the one that they continue, as those in the braces of a `use` do.
fn note_paths(tokens: &[TokenTree], before: &[String], found: &mut Vec<ModulePath>) {
    let mut rest = tokens;
    while let [first, after @ ..] = rest {
        rest = after;
        let word = match first {
            TokenTree::Ident(word) => word.to_string(),
            TokenTree::Group(group) => {
                note_paths(&without_tests(group.stream()), &[], found);
                continue;
            }
            _ => continue,
        };
        if word == "as" && !before.is_empty() {
            // Another name for what was just noted.
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
                    note_paths(&without_tests(group.stream()), &path, found);
                    path.clear();
                }
                // All of it, or the types that it is given.
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

/// The arrows of circles, and between circles. All others are removed, round by round: no arrow leads to their beginning, or from their end.
fn circles<'a>(arrows: &BTreeMap<&'a Path, BTreeSet<&'a Path>>) -> Vec<(&'a Path, &'a Path)> {
    let all = arrows
        .iter()
        .flat_map(|(from, named)| named.iter().map(|to| (*from, *to)));
    let mut left: Vec<_> = all.collect();
    loop {
        let (from, to): (BTreeSet<_>, BTreeSet<_>) = left.iter().copied().unzip();
        let before = left.len();
        left.retain(|arrow| to.contains(arrow.0) && from.contains(arrow.1));
        if left.len() == before {
            return left;
        }
    }
}

#[test]
fn no_files_of_a_crate_form_a_circle() {
    let root = super::repo_rules::root();
    let mut found = Vec::new();
    for folder in super::repo_rules::folders_of_crates() {
        let sources = root.join(folder).join("src");
        for (from, to) in circles(&Crate::read(&sources).arrows()) {
            let short = |file: &Path| file.strip_prefix(&root).unwrap().display().to_string();
            found.push(format!("{} names {}", short(from), short(to)));
        }
    }
    assert!(
        found.is_empty(),
        "put what both need into a third file:\n{}",
        found.join("\n")
    );
}

/// A crate of four files in which `b` and `c` name each other, one within braces and the other within a macro. Only their tests name `a`.
#[test]
fn a_circle_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let files = r#"
lib.rs: mod a; mod b; #[cfg(test)] mod tests; pub use a::f;
a.rs: use crate::b::g; pub fn f() { g() }
b/mod.rs: mod c; use self::{c::{h as k}}; pub const N: u32 = 1; pub fn g() { k() }
b/c.rs: #[cfg(test)] use crate::a::{f}; pub fn h() { println!("{}", super::N) } #[cfg(test)] fn t() { crate::a::f() } #[cfg(test)] mod tests { use crate::a::f; }"#;
    fs::create_dir(folder.path().join("b")).unwrap();
    for (name, text) in files.lines().filter_map(|it| it.split_once(": ")) {
        fs::write(folder.path().join(name), text).unwrap();
    }
    let read = Crate::read(folder.path());
    let [b, c] = ["b/mod.rs", "b/c.rs"].map(|name| folder.path().join(name));
    assert_eq!(circles(&read.arrows()), [(&*c, &*b), (&*b, &*c)]);
}
