//! The page that an experiment leaves: claim, command, time, expected, got, differences.
//! Its text is a template beside the experiment; its numbers come from results alone, so that none can be stale.

use std::fmt;

use driml_machine::units::rough_duration;

use crate::template::{self, Values};

const SMOKE: &str =
    "**This is the smoke length: it shows that everything works, and its numbers mean nothing.**";

/// Numbers in rows and columns, as Markdown.
#[derive(Debug, Default)]
pub(super) struct Table {
    pub(super) header: Vec<String>,
    pub(super) rows: Vec<Vec<String>>,
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rule = vec!["---".to_owned(); self.header.len()];
        let lines = [&self.header, &rule].into_iter().chain(&self.rows);
        let lines: Vec<_> = lines
            .map(|cells| format!("| {} |", cells.join(" | ")))
            .collect();
        f.write_str(&lines.join("\n"))
    }
}

/// A page, filled in but for the time that it took.
#[derive(Debug)]
pub(super) struct Page {
    template: &'static str,
    values: Values,
}

impl Page {
    /// The page of this template; `command` repeats the experiment, which was of the smoke length or not.
    pub(super) fn new(
        template: &'static str,
        mut values: Values,
        command: &str,
        smoke: bool,
    ) -> Self {
        values.set("command", command);
        values.set("smoke", if smoke { SMOKE } else { "" });
        Self { template, values }
    }

    /// As Markdown. `seconds` is the time that all pieces took together, made `at_once` at a time.
    pub(super) fn text(&self, seconds: f64, at_once: u32) -> String {
        let at_once = match at_once {
            1 => String::new(),
            jobs => format!(" of runs, {jobs} at once,"),
        };
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let time = rough_duration(seconds);
        let mut values = self.values.clone();
        values.set(
            "time",
            format!("{time}{at_once} on a machine with {cores} cores."),
        );
        template::fill(self.template, &values)
    }
}

/// What came out, for the terminal: the list below "Got".
pub(super) fn summary(page: &str) -> String {
    let list = page.split("**Got.**\n\n").nth(1).unwrap_or_default();
    list.split("\n\n").next().unwrap_or_default().to_owned() + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_its_parts_and_says_when_it_is_a_smoke_test() {
        let table = Table {
            header: vec!["a".into(), "b".into()],
            rows: vec![vec!["1".into(), "2".into()]],
        };
        let template = "# T\n\n{smoke}\n\n**Command.** `{command}`\n\n**Time.** {time}\n\n**Got.**\n\n* {got}\n\nNumbers:\n\n{table}\n";
        let mut values = Values::default();
        values.set("got", 0.5).set("table", table);
        let page = |smoke| Page::new(template, values.clone(), "driml experiment t", smoke);
        let text = page(true).text(130.0, 1);
        for part in [
            "# T\n",
            "smoke length",
            "**Command.** `driml experiment t`",
            "**Time.** 2 min on",
            "**Got.**\n\n* 0.5\n",
            "Numbers:\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        assert_eq!(summary(&text), "* 0.5\n");
        assert!(
            page(true)
                .text(130.0, 2)
                .contains("**Time.** 2 min of runs, 2 at once, on")
        );
        assert!(!page(false).text(1.0, 1).contains("smoke length"));
    }
}
