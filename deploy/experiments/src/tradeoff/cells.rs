//! Cells of the tables of a trade-off: numbers as a page and a file of data have them.

use crate::{page::Table, statistics::Interval};

/// A difference, with its sign.
pub(super) fn signed(it: &Interval) -> String {
    match it.ends {
        None => format!("{:+.2}", it.mean),
        Some((low, high)) => format!("{:+.2} [{low:+.2}, {high:+.2}]", it.mean),
    }
}

/// A number of a file of data, empty if there is none.
pub(super) fn cell_of_data(value: Option<f64>) -> String {
    value.map_or(String::new(), |value| format!("{value:.4}"))
}

/// A cell of a page, a dash if there is nothing.
pub(super) fn cell<T>(value: Option<T>, text: impl Fn(T) -> String) -> String {
    value.map_or_else(|| "-".into(), text)
}

/// A table of these rows.
pub(super) fn table(header: &[&str], rows: Vec<Vec<String>>) -> Table {
    Table {
        header: header.iter().map(|&it| it.to_owned()).collect(),
        rows,
    }
}
