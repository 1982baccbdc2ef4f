//! The text of a page: a Markdown file beside an experiment's settings, with {placeholders} for what the runs gave.
//!
//! * `{name}` stands for a value. Anything else in braces, such as s_{t+1}, is text.
//! * `* {name}` with a list as its value becomes one item for each of its entries.
//! * What stands between `{if name}` or `{unless name}` and `{end}` is kept where that is so; an item or paragraph of which
//!   nothing is left is left out.
//! * A block that is a placeholder alone may be a whole table, and is left out where it is empty.
//! * A picture gets its caption below it, with a link to the SVG.
//! * Lines are joined: how the file is wrapped does not matter.

use std::{collections::BTreeMap, fmt::Display};

/// What a placeholder stands for.
#[derive(Clone, Debug)]
enum Value {
    Text(String),
    Items(Vec<String>),
    Truth(bool),
}

/// What the placeholders of a page stand for.
#[derive(Clone, Debug, Default)]
pub(crate) struct Values(BTreeMap<&'static str, Value>);

impl Values {
    /// A number or words, or a whole block.
    pub(crate) fn set(&mut self, name: &'static str, value: impl Display) -> &mut Self {
        self.0.insert(name, Value::Text(value.to_string()));
        self
    }

    /// Entries of a list.
    pub(crate) fn items(&mut self, name: &'static str, items: Vec<String>) -> &mut Self {
        self.0.insert(name, Value::Items(items));
        self
    }

    /// Whether what hangs on it is on the page.
    pub(crate) fn when(&mut self, name: &'static str, truth: bool) -> &mut Self {
        self.0.insert(name, Value::Truth(truth));
        self
    }

    fn get(&self, name: &str) -> &Value {
        let value = self.0.get(name);
        value.unwrap_or_else(|| {
            panic!("page.md has {{{name}}}, and its experiment gives no such value")
        })
    }
}

/// The page that `template` becomes.
///
/// # Panics
/// The template, which is built in, has a placeholder without a value.
pub(crate) fn fill(template: &str, values: &Values) -> String {
    let blocks = template.split("\n\n").map(str::trim);
    let filled = blocks.filter_map(|block| match block.starts_with("* ") {
        true => list(block, values),
        false => paragraph(block, values),
    });
    filled.collect::<Vec<_>>().join("\n\n") + "\n"
}

fn list(block: &str, values: &Values) -> Option<String> {
    let mut items: Vec<String> = Vec::new();
    for line in block.lines() {
        match (line.strip_prefix("* "), items.last_mut()) {
            (None, Some(item)) => *item += &format!(" {}", line.trim()),
            (item, _) => items.push(item.unwrap_or(line).to_owned()),
        }
    }
    let mut lines = Vec::new();
    for item in items {
        match whole(&item).map(|name| values.get(name)) {
            Some(Value::Items(entries)) => lines.extend(entries.iter().cloned()),
            _ => {
                let item = substituted(&kept(&item, values), values);
                lines.extend((!item.is_empty()).then_some(item));
            }
        }
    }
    let lines: Vec<_> = lines.iter().map(|line| format!("* {line}")).collect();
    (!lines.is_empty()).then(|| lines.join("\n"))
}

fn paragraph(block: &str, values: &Values) -> Option<String> {
    let block = block.lines().map(str::trim).collect::<Vec<_>>().join(" ");
    let text = substituted(&kept(&block, values), values);
    if let Some((caption, stem)) = picture(&text) {
        return Some(format!("{text}\n\n{caption} ([SVG]({stem}.svg))"));
    }
    let text = text.trim_end();
    (!text.is_empty()).then(|| text.to_owned())
}

/// Caption and stem of `![caption](stem.png)`.
fn picture(text: &str) -> Option<(&str, &str)> {
    let (caption, file) = text.strip_prefix("![")?.rsplit_once("](")?;
    Some((caption, file.strip_suffix(".png)")?))
}

/// The name, where `text` is a placeholder and nothing else.
fn whole(text: &str) -> Option<&str> {
    let name = text.strip_prefix('{')?.strip_suffix('}')?;
    is_name(name).then_some(name)
}

fn is_name(text: &str) -> bool {
    let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    text.starts_with(|c: char| c.is_ascii_lowercase()) && text.chars().all(plain)
}

/// The text with what its conditions keep.
fn kept(text: &str, values: &Values) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = ["{if ", "{unless "]
        .iter()
        .filter_map(|it| rest.find(it))
        .min()
    {
        let (before, condition) = rest.split_at(at);
        let parts = condition.split_once('}');
        let parts =
            parts.and_then(|(head, it)| Some((head.split_once(' ')?, it.split_once("{end}")?)));
        let ((word, name), (body, after)) = parts.expect("page.md ends each {if ..} with {end}");
        let Value::Truth(truth) = values.get(name) else {
            panic!("page.md asks whether {name}, which is a text");
        };
        out += before;
        if *truth == (word == "{if") {
            out += body;
        }
        rest = after;
    }
    out + rest
}

fn substituted(text: &str, values: &Values) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('{') {
        out += before;
        match after.split_once('}').filter(|(name, _)| is_name(name)) {
            Some((name, after)) => {
                match values.get(name) {
                    Value::Text(text) => out += text,
                    other => panic!("page.md has {{{name}}} in a text, but it is {other:?}"),
                }
                rest = after;
            }
            None => {
                out.push('{');
                rest = after;
            }
        }
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_is_filled_in() {
        let template = "# T\n\n{smoke}\n\n**Claim.** s_{t+1} is {a}\n  wide.\n\n* {if yes}one{end}\n* {if no}two{end}\n* {a},{unless no}\n  \
                        wrapped{end}\n* {more}\n\n{table}\n\n![A {a}](fig.png)\n";
        let mut values = Values::default();
        values
            .set("smoke", "")
            .set("a", 7)
            .set("table", "x\n\n| b |");
        values.when("yes", true).when("no", false);
        values.items("more", vec!["three".into(), "four".into()]);
        assert_eq!(
            fill(template, &values),
            "# T\n\n**Claim.** s_{t+1} is 7 wide.\n\n* one\n* 7, wrapped\n* three\n* four\n\nx\n\n| b |\n\n![A 7](fig.png)\n\n\
             A 7 ([SVG](fig.svg))\n"
        );
    }

    #[test]
    #[should_panic(expected = "gives no such value")]
    fn a_placeholder_without_a_value_is_a_mistake() {
        fill("{nothing}", &Values::default());
    }
}
