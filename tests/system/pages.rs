//! The repository's Markdown pages: links are valid, the book lists its pages, and the text stays short.
//! Links to other sites are not followed. Templates of result pages (`.md.j2`) only count as words.

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use super::repo_rules::{Source, read, root, sources};

/// Most lines of the README, which should fit on two screens.
const README_LINES_MAX: usize = 130;
const README_WORDS_MAX: usize = 1_000;
/// Most words of all Markdown, including templates and generated pages.
const WORDS_MAX: usize = 25_000;
/// Most words of a table's cell, apart from links and code.
const CELL_WORDS_MAX: usize = 12;

const DOCS: &str = "deploy/docs/src";
const LANGUAGES: [&str; 7] = ["", "sh", "text", "toml", "rust", "python", "ini"];

/// Returns the Markdown pages without the templates.
fn pages() -> Vec<Source> {
    sources(&[".md"])
}

/// Checks that `find` finds nothing wrong in any page.
fn check_pages(what: &str, find: impl Fn(&Source) -> Vec<String>) {
    let mut wrong = Vec::new();
    for page in pages() {
        let found = find(&page).into_iter();
        wrong.extend(found.map(|it| format!("{}: {it}", page.name)));
    }
    assert!(wrong.is_empty(), "{what}:\n{}", wrong.join("\n"));
}

/// Counts the tokens with a letter or a digit. The bars of a table are not words.
fn words(text: &str) -> usize {
    let is_word = |token: &&str| token.chars().any(char::is_alphanumeric);
    text.split_whitespace().filter(is_word).count()
}

/// The lines outside code blocks.
fn prose(text: &str) -> impl Iterator<Item = &str> {
    let mut in_code = false;
    text.lines().filter(move |line| {
        let is_fence = line.trim_start().starts_with("```");
        in_code ^= is_fence;
        !in_code && !is_fence
    })
}

/// Returns the anchors of the headings, by which links name them.
fn anchors(text: &str) -> BTreeSet<String> {
    let headings = prose(text).filter(|line| line.starts_with('#'));
    let anchor = |line: &str| {
        let title = line.trim_start_matches('#').trim().to_lowercase();
        title
            .chars()
            .filter(|c| c.is_alphanumeric() || " -_".contains(*c))
            .map(|c| if c == ' ' { '-' } else { c })
            .collect()
    };
    headings.map(anchor).collect()
}

#[test]
fn every_link_leads_to_a_file_and_heading_of_the_repository() {
    check_pages("links that lead nowhere", |page| {
        let path = root().join(&page.name);
        let resolves = |link: &str| {
            let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = match file {
                "" => path.clone(),
                file => path.parent().unwrap().join(file),
            };
            let has_it = |text: String| anchors(&text).contains(anchor);
            target.exists() && (anchor.is_empty() || fs::read_to_string(&target).is_ok_and(has_it))
        };
        let rests = page.text.split("](").skip(1);
        let links = rests.filter_map(|rest| rest.split_once(')').map(|it| it.0));
        links
            .filter(|link| !link.contains("://") && !resolves(link))
            .map(str::to_owned)
            .collect()
    });
}

#[test]
fn code_blocks_are_closed_and_of_a_known_language() {
    check_pages("code blocks", |page| {
        let fences = page.text.lines().filter_map(|it| it.strip_prefix("```"));
        let fences: Vec<_> = fences.collect();
        let begun = fences.iter().step_by(2);
        let unknown = begun.filter(|language| !LANGUAGES.contains(language));
        let mut wrong: Vec<_> = unknown.map(|language| format!("```{language}")).collect();
        if fences.len() % 2 != 0 {
            wrong.push("a block is not closed".into());
        }
        wrong
    });
}

#[test]
fn the_book_lists_each_of_its_pages_once() {
    let summary = read(format!("{DOCS}/SUMMARY.md"));
    let mut listed: Vec<_> = summary
        .split("](")
        .skip(1)
        .map(|rest| Path::new(DOCS).join(rest.split(')').next().unwrap()))
        .collect();
    listed.sort();
    let mut existing: Vec<_> = pages()
        .into_iter()
        .filter(|page| page.name.starts_with(DOCS) && !page.name.ends_with("SUMMARY.md"))
        .map(|page| PathBuf::from(page.name))
        .collect();
    existing.sort();
    assert_eq!(listed, existing);
}

#[test]
fn the_page_of_the_protocol_has_every_key() {
    let page = read(format!("{DOCS}/reference/protocol.md"));
    let table = read("protocol/src/messages/table.rs");
    let keys = table.split(", at \"").skip(1);
    let keys: Vec<_> = keys.filter_map(|rest| rest.split('"').next()).collect();
    for key in &keys {
        let has = [format!("`{key}`"), format!("`{key}/")];
        assert!(has.iter().any(|it| page.contains(it)), "{key}");
    }
    assert!(keys.len() > 10, "only {keys:?} were found");
}

#[test]
fn cells_of_tables_are_short() {
    check_pages("cells of more than 12 words", |page| {
        let mut long = Vec::new();
        for row in prose(&page.text).filter(|line| line.starts_with('|')) {
            // Code in backticks, and the text and targets of links, do not count.
            let plain: String = row.split('`').step_by(2).collect();
            let is_long = |cell: &&str| words(&without_links(cell)) > CELL_WORDS_MAX;
            long.extend(plain.split('|').filter(is_long).map(str::to_owned));
        }
        long
    });
}

fn without_links(text: &str) -> String {
    let mut left = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("](") {
        left += before.rsplit_once('[').map_or(before, |(text, _)| text);
        rest = after.split_once(')').map_or("", |(_, text)| text);
    }
    left + rest
}

#[test]
fn all_pages_together_stay_within_the_budget() {
    let counts: Vec<_> = sources(&[".md", ".md.j2"])
        .into_iter()
        .map(|page| (words(&page.text), page.name))
        .collect();
    let sum: usize = counts.iter().map(|(words, _)| words).sum();
    assert!(sum <= WORDS_MAX, "{sum} words: {counts:#?}");
}

#[test]
fn the_readme_is_short() {
    let text = read("README.md");
    let (lines, words) = (text.lines().count(), words(&text));
    let is_short = lines <= README_LINES_MAX && words <= README_WORDS_MAX;
    assert!(is_short, "{lines} lines and {words} words");
}
