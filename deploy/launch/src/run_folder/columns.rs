//! A CSV file read by the names of its columns.

use std::{fs, io::ErrorKind, path::Path, str::FromStr};

use anyhow::Context;
use csv::StringRecord;

use crate::console;

/// The whole rows of a file that a run writes.
#[derive(Clone, Debug, Default)]
pub struct Columns {
    /// The columns' names.
    pub header: Vec<String>,
    /// A record for each row, without the header.
    pub rows: Vec<StringRecord>,
}

impl Columns {
    /// Reads a file's text. What follows the last line's end is still being written, or was cut off, and is left out.
    ///
    /// # Errors
    /// Rows of different lengths, or text that is no UTF-8.
    pub fn parse(text: &[u8]) -> Result<Self, csv::Error> {
        let whole = text.iter().rposition(|&byte| byte == b'\n');
        let mut reader = csv::Reader::from_reader(&text[..whole.map_or(0, |end| end + 1)]);
        let header = reader.headers()?.iter().map(String::from).collect();
        let rows = reader.records().collect::<Result<_, _>>()?;
        Ok(Self { header, rows })
    }

    /// Reads the file at `path`; one that is not there is empty.
    ///
    /// # Errors
    /// As [`Columns::parse`], or a file system that refuses.
    pub(super) fn read(path: &Path) -> anyhow::Result<Self> {
        let reading = || format!("reading {}", path.display());
        match fs::read(path) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(Self::default()),
            text => Self::parse(&text.with_context(reading)?).with_context(reading),
        }
    }

    /// The place of the column `name`; none if there is no such column.
    pub fn place(&self, name: &str) -> Option<usize> {
        self.header.iter().position(|it| it == name)
    }

    /// What `row` has in the column `name`; none if that is empty, or of another type.
    pub fn value<T: FromStr>(&self, row: &StringRecord, name: &str) -> Option<T> {
        row.get(self.place(name)?)?.parse().ok()
    }

    /// What the last row has in the column `name`.
    pub fn last<T: FromStr>(&self, name: &str) -> Option<T> {
        self.value(self.rows.last()?, name)
    }
}

/// Writes rows that are to leave the table at `path` into a file of their own beside it, and says so; nothing if there are none.
///
/// # Errors
/// A file system that refuses: the table is then as it was.
pub(super) fn set_aside(
    path: &Path,
    header: &[String],
    rows: &[StringRecord],
) -> anyhow::Result<()> {
    if rows.is_empty() {
        return Ok(());
    }
    let aside = |n: u32| path.with_extension(format!("aside-{n}.csv"));
    let free = (1..).map(aside).find(|it| !it.exists());
    let aside = free.context("no name is free beside the table")?;
    let writing = || format!("writing {}", aside.display());
    let mut csv = csv::Writer::from_path(&aside).with_context(writing)?;
    csv.write_record(header).with_context(writing)?;
    for row in rows {
        csv.write_record(row).with_context(writing)?;
    }
    csv.flush().with_context(writing)?;
    let name = |path: &Path| path.file_name().unwrap_or_default().display().to_string();
    console::line(&format!(
        "{} rows of {} are past the point where the run is resumed; they are now in {}",
        rows.len(),
        name(path),
        name(&aside)
    ));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_found_by_name_in_whole_rows_alone() {
        let read = Columns::parse(b"frames,loss\n1,\n2,0.5\n3,0.2").unwrap();
        assert_eq!(read.rows.len(), 2);
        assert_eq!(
            (read.last("frames"), read.last("loss")),
            (Some(2), Some(0.5))
        );
        assert_eq!(read.value::<f64>(&read.rows[0], "loss"), None);
        assert_eq!(read.last::<u64>("k"), None);
        assert!(Columns::parse(b"frames,lo").unwrap().header.is_empty());
    }
}
