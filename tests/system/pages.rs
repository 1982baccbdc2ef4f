//! The repository's Markdown pages: what they link to is there, and the first one stays short.
//! It follows no link to another site, and takes templates of pages (in a `src`) for what they are.

use std::fs;

use super::repo_rules::files;

/// Lines of the README, which is to be read on two screens; chapters belong to the folders they are about.
const README_LINES_MAX: usize = 130;

#[test]
fn every_link_leads_to_a_file_of_the_repository() {
    let mut wrong = Vec::new();
    for (name, path) in files()
        .into_iter()
        .filter(|(name, _)| name.ends_with(".md") && !name.contains("/src/"))
    {
        let text = fs::read_to_string(&path).unwrap();
        let folder = path.parent().unwrap();
        for rest in text.split("](").skip(1) {
            let Some((link, _)) = rest.split_once(')') else {
                continue;
            };
            let file = link.split('#').next().unwrap();
            let is_ours = !link.contains("://") && !file.is_empty();
            if is_ours && !folder.join(file).exists() {
                wrong.push(format!("{name}: {link}"));
            }
        }
    }
    assert!(
        wrong.is_empty(),
        "links that lead nowhere:\n{}",
        wrong.join("\n")
    );
}

#[test]
fn the_readme_is_short() {
    let text = fs::read_to_string(super::repo_rules::root().join("README.md")).unwrap();
    let lines = text.lines().count();
    assert!(
        lines <= README_LINES_MAX,
        "{lines} lines; at most {README_LINES_MAX}"
    );
}
