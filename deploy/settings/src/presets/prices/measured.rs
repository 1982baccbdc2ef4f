//! The figures of `driml tradeoff` as they are kept in the repository, and how they are put into words.
//! It knows no preset; which figures are said of a setting is in `prices.toml`.

use std::collections::BTreeMap;

use serde::Deserialize;

/// The worlds that were measured, and the data of their pages.
const PAGES: [(&str, &str); 3] = [
    (
        "Ms. PacMan at 42 x 38",
        include_str!("../../../../experiments/results/tradeoff/mspacman/levels.csv"),
    ),
    (
        "coinrun",
        include_str!("../../../../experiments/results/tradeoff/coinrun/levels.csv"),
    ),
    (
        "one level of fruitbot",
        include_str!("../../../../experiments/results/tradeoff/fruitbot/levels.csv"),
    ),
];

/// One number of a level in words: "{}" in its text is that of each world, "{base}" those of its bases.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Number {
    pub(super) text: String,
    column: String,
    #[serde(rename = "as")]
    form: Form,
}

impl Number {
    fn write(&self, row: &BTreeMap<String, String>) -> Option<String> {
        Some(self.form.write(value(row, &self.column)?))
    }
}

/// How a number is written.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Form {
    /// 1.36
    Factor,
    /// 3.4%; what rounds to nothing as 2e-6
    Share,
    /// Bytes as 1.99
    Megabytes,
}

impl Form {
    fn write(self, number: f64) -> String {
        match self {
            Self::Factor => format!("{number:.2}"),
            Self::Megabytes => format!("{:.2}", number / 1e6),
            Self::Share if number < 1e-3 => format!("{number:.0e}"),
            Self::Share => format!("{:.1}%", 100.0 * number),
        }
    }
}

/// What was measured in one world.
pub(super) struct Page {
    pub(super) name: &'static str,
    /// By column, a row for each base and level.
    rows: Vec<BTreeMap<String, String>>,
}

/// All that was measured.
pub(super) fn pages() -> Vec<Page> {
    let page = |(name, text): (&'static str, &str)| {
        let mut reader = csv::Reader::from_reader(text.as_bytes());
        let rows = reader.deserialize().collect::<Result<_, _>>();
        Page {
            name,
            rows: rows.unwrap_or_else(|e| {
                panic!("levels.csv of {name} is built in, and a test reads it: {e}")
            }),
        }
    };
    PAGES.into_iter().map(page).collect()
}

impl Page {
    /// What was measured of a dial's level; nothing if it was never run.
    pub(super) fn measured(&self, dial: &str, level: &str) -> Option<Measured<'_>> {
        let row = |level: &str| {
            let mut rows = self.rows.iter();
            rows.find(|row| row["dial"] == dial && row["level"] == level)
        };
        let level = row(level)?;
        Some(Measured {
            base: row(&level["base"])?,
            level,
        })
    }
}

/// A level and its base.
pub(super) struct Measured<'a> {
    level: &'a BTreeMap<String, String>,
    base: &'a BTreeMap<String, String>,
}

impl Measured<'_> {
    /// A number of the level in words; nothing if it was not measured.
    pub(super) fn level(&self, number: &Number) -> Option<String> {
        number.write(self.level)
    }

    /// The same number of the base.
    pub(super) fn base(&self, number: &Number) -> Option<String> {
        number.write(self.base)
    }

    /// A column that is a factor of the base.
    pub(super) fn factor(&self, column: &str) -> Option<String> {
        Some(Form::Factor.write(value(self.level, column)?))
    }

    /// The mean return in training beside the base's, with the interval of the difference.
    pub(super) fn training_return(&self) -> Option<String> {
        let of = |end: &str| value(self.level, &format!("training_return_minus_base{end}"));
        let (mean, low, high) = (of("")?, of("_low")?, of("_high")?);
        Some(format!(
            "{mean:+.2} [{low:+.2}, {high:+.2}] from {:.2} ({} seeds)",
            value(self.base, "training_return")?,
            self.level["seeds"]
        ))
    }
}

fn value(row: &BTreeMap<String, String>, column: &str) -> Option<f64> {
    row.get(column)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_as_a_reader_expects() {
        let written = |form: Form, number| form.write(number);
        assert_eq!(written(Form::Factor, 1.3635), "1.36");
        assert_eq!(written(Form::Share, 0.033_69), "3.4%");
        assert_eq!(written(Form::Share, 1.0), "100.0%");
        assert_eq!(written(Form::Share, 2.3e-6), "2e-6");
        assert_eq!(written(Form::Megabytes, 1_986_778.0), "1.99");
    }

    #[test]
    fn a_level_is_read_with_its_base() {
        let [page] = [Page {
            name: "a world",
            rows: csv::Reader::from_reader(
                "dial,level,base,seeds,rows_gain,training_return,training_return_minus_base,training_return_minus_base_low,training_return_minus_base_high\n\
                 p,f32,f32,6,1.0,0.9,,,\n\
                 p,bf16,f32,3,1.5,0.7,-0.2,-0.3,0.1\n"
                    .as_bytes(),
            )
            .deserialize()
            .collect::<Result<_, _>>()
            .unwrap(),
        }];
        let measured = page.measured("p", "bf16").unwrap();
        let number: Number =
            toml::from_str("text = \"{}, not {base}\"\ncolumn = \"rows_gain\"\nas = \"factor\"")
                .unwrap();
        assert_eq!(measured.level(&number).unwrap(), "1.50");
        assert_eq!(measured.base(&number).unwrap(), "1.00");
        assert_eq!(
            measured.training_return().unwrap(),
            "-0.20 [-0.30, +0.10] from 0.90 (3 seeds)"
        );
        assert!(page.measured("p", "f64").is_none());
    }
}
