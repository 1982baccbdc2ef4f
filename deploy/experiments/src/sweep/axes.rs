//! The axes of a sweep, and its cells: every combination of the values on the command line.
//! The settings are not interpreted here: `driml train` receives each of them unchanged.

use driml_machine::error::{Usage, usage};
use serde::{Deserialize, Serialize};

/// The most runs of a sweep. More are probably a typing error, and are rejected.
pub(super) const RUNS_MAX: usize = 10_000;

/// A setting that varies over the sweep, or is fixed if it has a single value.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Axis {
    /// The column header: `env`, `agent`, or the dotted path of a setting.
    pub(crate) name: String,
    pub(crate) values: Vec<String>,
}

/// One combination: the name and the value of each axis, in the order of the axes.
pub(crate) type Cell = Vec<(String, String)>;

impl Axis {
    /// Reads `KEY=VALUE,VALUE,..`. Commas within brackets, braces and quotes belong to a value.
    pub(crate) fn parse(text: &str) -> Result<Self, Usage> {
        let hint =
            "--set takes table.key=value,value,.., such as learner.update.adam.lr=1e-4,2.5e-4";
        let parts = text.split_once('=');
        let (name, values) = parts.ok_or_else(|| usage!("--set {text:?} has no '='; {hint}"))?;
        let values = split_at_commas(values).into_iter();
        let axis = Self {
            name: name.trim().into(),
            values: values.map(|it| it.trim().to_owned()).collect(),
        };
        axis.check_values(hint)?;
        Ok(axis)
    }

    pub(crate) fn check_values(&self, hint: &str) -> Result<(), Usage> {
        match self.values.iter().any(String::is_empty) {
            true => Err(usage!("{} has an empty value; {hint}", self.name)),
            false => Ok(()),
        }
    }
}

/// Splits `text` at the commas outside brackets, braces and quotes.
fn split_at_commas(text: &str) -> Vec<&str> {
    let (mut depth, mut quote, mut start) = (0_i32, None, 0);
    let mut parts = Vec::new();
    for (at, letter) in text.char_indices() {
        match (quote, letter) {
            (Some(open), _) if letter == open => quote = None,
            (Some(_), _) => {}
            (None, '"' | '\'') => quote = Some(letter),
            (None, '[' | '{') => depth += 1,
            (None, ']' | '}') => depth -= 1,
            (None, ',') if depth == 0 => {
                parts.push(&text[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&text[start..]);
    parts
}

/// Returns every combination of the axes' values. The last axis changes fastest. More than `RUNS_MAX` runs are an error.
pub(crate) fn cells(axes: &[Axis], seeds: u32) -> Result<Vec<Cell>, Usage> {
    let counts = axes.iter().map(|axis| axis.values.len());
    let runs = counts.fold(seeds as usize, usize::saturating_mul);
    if runs > RUNS_MAX {
        return Err(usage!(
            "{runs} runs: a sweep has at most {RUNS_MAX}; vary fewer settings at a time"
        ));
    }
    let mut cells = vec![Cell::new()];
    for Axis { name, values } in axes {
        let extended = |cell: Cell| {
            let values = values.iter().map(|value| (name.clone(), value.clone()));
            values.map(move |it| [&cell[..], &[it]].concat())
        };
        cells = cells.into_iter().flat_map(extended).collect();
    }
    Ok(cells)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commas_part_values_unless_something_is_around_them() {
        let values = |text: &str| Axis::parse(text).unwrap().values;
        assert_eq!(values("a.b=1"), ["1"]);
        assert_eq!(values("a.b=1, 2,3"), ["1", "2", "3"]);
        assert_eq!(
            values("model.conv=[{ out = 1, kernel = 2 }, { out = 3 }],[]"),
            ["[{ out = 1, kernel = 2 }, { out = 3 }]", "[]"]
        );
        assert_eq!(values("a.b=\"x,y\",'z,'"), ["\"x,y\"", "'z,'"]);
        for (wrong, why) in [
            ("a.b", "has no '='"),
            ("a.b=", "has an empty value"),
            ("a.b=1,,2", "has an empty value"),
        ] {
            let said = Axis::parse(wrong).unwrap_err().to_string();
            assert!(said.contains(why), "{wrong}: {said}");
        }
    }

    #[test]
    fn cells_are_all_combinations() {
        let axes = ["a=1,2", "b=x", "c=3,4"].map(|it| Axis::parse(it).unwrap());
        let found = cells(&axes, 2).unwrap();
        let values = |cell: &Cell| cell.iter().map(|it| it.1.as_str()).collect::<String>();
        let found: Vec<String> = found.iter().map(values).collect();
        assert_eq!(found, ["1x3", "1x4", "2x3", "2x4"]);
        assert_eq!(cells(&[], 1).unwrap(), [Cell::new()]);
        let many: Vec<String> = (0..200).map(|it| it.to_string()).collect();
        let axis = Axis::parse(&format!("a={}", many.join(","))).unwrap();
        assert!(cells(&[axis.clone(), axis], 1).is_err());
    }
}
