//! Cells of the tables of a trade-off: numbers as a page and a file of data have them.

use crate::{
    page::Table,
    statistics::{Difference, Interval},
};

/// A difference, with its sign.
pub(super) fn signed(it: &Difference) -> String {
    let Interval { mean, ends } = it.interval;
    match ends {
        None => format!("{mean:+.2} (one seed)"),
        Some((low, high)) => format!("{mean:+.2} [{low:+.2}, {high:+.2}]"),
    }
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
