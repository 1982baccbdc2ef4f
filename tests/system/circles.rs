//! No files of a crate form a circle: each can be read knowing only those that it names, and they never lead back to it.
//! It reads the sources; it does not know what the compiler makes of macros' results.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

use proc_macro2::{TokenStream, TokenTree};
use syn::{
    Attribute, Item, ItemMod, ItemUse, Macro, UseTree,
    visit::{self, Visit},
};

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
                read.read_file(&root, &vec![], folder);
            }
        }
        read
    }

    /// Reads a module's file; files of its children lie in `folder`.
    fn read_file(&mut self, file: &Path, module: &ModulePath, folder: &Path) {
        let text = fs::read_to_string(file).unwrap();
        let items = syn::parse_file(&text)
            .unwrap_or_else(|e| panic!("{}: {e}", file.display()))
            .items;
        self.files
            .entry(module.clone())
            .or_insert_with(|| file.into());
        self.read_items(&items, file, module, folder);
    }

    fn read_items(&mut self, items: &[Item], file: &Path, module: &ModulePath, folder: &Path) {
        let children: BTreeSet<_> = items
            .iter()
            .filter_map(|item| match item {
                Item::Mod(child) => Some(child.ident.to_string()),
                _ => None,
            })
            .collect();
        for item in items {
            if let Item::Mod(child) = item {
                self.read_module(child, file, module, folder);
                continue;
            }
            let mut names = Names {
                module,
                children: &children,
                found: self.named.entry(file.into()).or_default(),
            };
            names.visit_item(item);
        }
    }

    fn read_module(&mut self, child: &ItemMod, file: &Path, module: &ModulePath, folder: &Path) {
        if is_test(&child.attrs) {
            return;
        }
        let name = child.ident.to_string();
        let path = [module.clone(), vec![name.clone()]].concat();
        if let Some((_, items)) = &child.content {
            self.files.insert(path.clone(), file.into());
            return self.read_items(items, file, &path, &folder.join(name));
        }
        let flat = folder.join(format!("{name}.rs"));
        let nested = folder.join(&name).join("mod.rs");
        let found = if flat.exists() { flat } else { nested };
        self.read_file(&found, &path, &folder.join(name));
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

/// Whether what has these attributes is compiled for tests alone.
fn is_test(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let list = attribute
            .path()
            .is_ident("cfg")
            .then(|| attribute.meta.require_list());
        list.is_some_and(|list| list.is_ok_and(|list| list.tokens.to_string() == "test"))
    })
}

/// Collects the paths of this crate that code names.
struct Names<'a> {
    module: &'a ModulePath,
    children: &'a BTreeSet<String>,
    found: &'a mut BTreeSet<ModulePath>,
}

impl Names<'_> {
    /// Notes `path` as written in this module, if it leads into this crate.
    fn note(&mut self, path: &[String]) {
        let mut from = match path.first().map(String::as_str) {
            Some("crate") => vec![],
            Some("self" | "super") => self.module.clone(),
            Some(first) if self.children.contains(first) => self.module.clone(),
            _ => return,
        };
        for segment in path {
            match segment.as_str() {
                "crate" | "self" => {}
                "super" => drop(from.pop()),
                name => from.push(name.into()),
            }
        }
        self.found.insert(from);
    }

    fn note_use(&mut self, before: &[String], tree: &UseTree) {
        let with = |name: &syn::Ident| [before, &[name.to_string()]].concat();
        match tree {
            UseTree::Path(path) => self.note_use(&with(&path.ident), &path.tree),
            UseTree::Name(name) => self.note(&with(&name.ident)),
            UseTree::Rename(rename) => self.note(&with(&rename.ident)),
            UseTree::Glob(_) => self.note(before),
            UseTree::Group(group) => {
                for tree in &group.items {
                    self.note_use(before, tree);
                }
            }
        }
    }

    /// What is within a macro's brackets need not be Rust; paths in it are found by their looks.
    fn note_tokens(&mut self, tokens: TokenStream) {
        let mut path = Vec::new();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Ident(name) if path.is_empty() || colons == 2 => {
                    path.push(name.to_string());
                    colons = 0;
                    continue;
                }
                TokenTree::Punct(punct) if punct.as_char() == ':' && !path.is_empty() => {
                    colons += 1;
                    continue;
                }
                _ => {}
            }
            self.note_written(&mut path);
            colons = 0;
            match token {
                TokenTree::Ident(name) => path.push(name.to_string()),
                TokenTree::Group(group) => self.note_tokens(group.stream()),
                _ => {}
            }
        }
        self.note_written(&mut path);
    }

    fn note_written(&mut self, path: &mut Vec<String>) {
        if path.len() > 1 {
            self.note(path);
        }
        path.clear();
    }
}

impl Visit<'_> for Names<'_> {
    fn visit_item(&mut self, item: &Item) {
        let attributes = match item {
            Item::Fn(item) => &item.attrs,
            Item::Impl(item) => &item.attrs,
            Item::Use(item) => &item.attrs,
            Item::Const(item) => &item.attrs,
            Item::Struct(item) => &item.attrs,
            _ => return visit::visit_item(self, item),
        };
        if !is_test(attributes) {
            visit::visit_item(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, function: &syn::ImplItemFn) {
        if !is_test(&function.attrs) {
            visit::visit_impl_item_fn(self, function);
        }
    }

    fn visit_item_use(&mut self, item: &ItemUse) {
        self.note_use(&[], &item.tree);
    }

    fn visit_path(&mut self, path: &syn::Path) {
        let segments: Vec<_> = path
            .segments
            .iter()
            .map(|it| it.ident.to_string())
            .collect();
        if segments.len() > 1 {
            self.note(&segments);
        }
        visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, call: &Macro) {
        self.note_tokens(call.tokens.clone());
        visit::visit_macro(self, call);
    }
}

/// The arrows from whose ends arrows lead back to their beginnings.
fn circles<'a>(arrows: &BTreeMap<&'a Path, BTreeSet<&'a Path>>) -> Vec<(&'a Path, &'a Path)> {
    let all = arrows
        .iter()
        .flat_map(|(from, named)| named.iter().map(|to| (*from, *to)));
    all.filter(|(from, to)| leads_to(arrows, to, from))
        .collect()
}

fn leads_to(arrows: &BTreeMap<&Path, BTreeSet<&Path>>, from: &Path, to: &Path) -> bool {
    let mut seen = BTreeSet::new();
    let mut next = vec![from];
    while let Some(file) = next.pop() {
        if file == to {
            return true;
        }
        if seen.insert(file) {
            next.extend(arrows.get(file).into_iter().flatten());
        }
    }
    false
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

/// A crate of four files in which `b` and `c` name each other, and one of them does so within a macro.
#[test]
fn a_circle_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let files = r#"
lib.rs: mod a; mod b; #[cfg(test)] mod tests; pub use a::f;
a.rs: use crate::b::g; pub fn f() { g() }
b/mod.rs: mod c; pub const N: u32 = 1; pub fn g() { self::c::h() }
b/c.rs: pub fn h() { println!("{}", super::N) } #[cfg(test)] mod tests { use crate::a::f; }"#;
    fs::create_dir(folder.path().join("b")).unwrap();
    for (name, text) in files.lines().filter_map(|it| it.split_once(": ")) {
        fs::write(folder.path().join(name), text).unwrap();
    }
    let read = Crate::read(folder.path());
    let [b, c] = ["b/mod.rs", "b/c.rs"].map(|name| folder.path().join(name));
    assert_eq!(circles(&read.arrows()), [(&*c, &*b), (&*b, &*c)]);
}
