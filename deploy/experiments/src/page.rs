//! The page that an experiment leaves: claim, command, time, expected, got, differences.
//! It is made from results alone, so that no number in it can be stale.

use driml_machine::units::rough_duration;

/// Numbers in rows and columns.
#[derive(Debug, Default)]
pub(super) struct Table {
    /// What it shows, and what its numbers are.
    pub(super) caption: String,
    pub(super) header: Vec<String>,
    pub(super) rows: Vec<Vec<String>>,
}

impl Table {
    fn text(&self) -> String {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let rule = vec!["---".to_owned(); self.header.len()];
        let rows: String = self.rows.iter().map(|row| line(row)).collect();
        format!(
            "{}\n\n{}{}{rows}\n",
            self.caption,
            line(&self.header),
            line(&rule)
        )
    }
}

/// What stands on the page.
#[derive(Debug, Default)]
pub(super) struct Page {
    /// Its first line.
    pub(super) title: String,
    /// What the paper claims.
    pub(super) claim: String,
    /// What repeats it.
    pub(super) command: String,
    /// What should come out.
    pub(super) expected: Vec<String>,
    /// What came out, numbers first.
    pub(super) got: Vec<String>,
    /// More of what came out.
    pub(super) tables: Vec<Table>,
    /// Where it differs from the paper, and why.
    pub(super) differences: Vec<String>,
    /// How it was done: sizes, seeds.
    pub(super) setup: Vec<String>,
    /// Stem and caption of each figure.
    pub(super) figures: Vec<(String, String)>,
    /// Name and content of each data file.
    pub(super) data: Vec<(String, String)>,
    /// Whether this was the smoke length.
    pub(super) smoke: bool,
}

impl Page {
    /// As Markdown. `seconds` is the time that all pieces took together, of which so many are made `at_once`.
    pub(super) fn text(&self, seconds: f64, at_once: u32) -> String {
        let at_once = match at_once {
            1 => String::new(),
            jobs => format!(" of runs, {jobs} at once,"),
        };
        let mut out = format!("# {}\n\n", self.title);
        if self.smoke {
            out += "**This is the smoke length: it shows that everything works, and its numbers mean nothing.**\n\n";
        }
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        out += &format!("**Claim.** {}\n\n", self.claim);
        out += &format!("**Command.** `{}`\n\n", self.command);
        out += &format!(
            "**Time.** {}{at_once} on a machine with {cores} cores.\n\n",
            rough_duration(seconds)
        );
        for (head, items) in [("Expected", &self.expected), ("Got", &self.got)] {
            out += &format!("**{head}.**\n\n{}\n", list(items));
        }
        self.tables.iter().for_each(|table| out += &table.text());
        for (head, items) in [
            ("Differences from the paper", &self.differences),
            ("How", &self.setup),
        ] {
            out += &format!("**{head}.**\n\n{}\n", list(items));
        }
        for (stem, caption) in &self.figures {
            out += &format!("![{caption}]({stem}.png)\n\n");
            out += &format!("{caption} ([SVG]({stem}.svg))\n\n");
        }
        out += "**Data.**\n\n";
        let files = self.data.iter();
        let files: Vec<String> = files
            .map(|(name, what)| format!("`{name}.csv`: {what}"))
            .collect();
        out += &list(&files);
        out
    }

    /// What came out, for the terminal.
    pub(super) fn summary(&self) -> String {
        list(&self.got)
    }
}

fn list(items: &[String]) -> String {
    items.iter().map(|item| format!("* {item}\n")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_all_its_parts_and_says_when_it_is_a_smoke_test() {
        let mut page = Page {
            title: "T".into(),
            claim: "C.".into(),
            command: "driml experiment t".into(),
            got: vec!["0.5".into()],
            tables: vec![Table {
                caption: "Numbers:".into(),
                header: vec!["a".into(), "b".into()],
                rows: vec![vec!["1".into(), "2".into()]],
            }],
            figures: vec![("fig".into(), "A figure".into())],
            smoke: true,
            ..Page::default()
        };
        let text = page.text(130.0, 1);
        for part in [
            "# T\n",
            "smoke length",
            "**Claim.** C.",
            "**Time.** 2 min on",
            "**Got.**\n\n* 0.5\n",
            "Numbers:\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\n",
            "![A figure](fig.png)",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        assert!(
            page.text(130.0, 2)
                .contains("**Time.** 2 min of runs, 2 at once, on")
        );
        page.smoke = false;
        assert!(!page.text(1.0, 1).contains("smoke length"));
    }
}
