//! A CSV file read by the names of its columns.

use std::str::FromStr;

use csv::StringRecord;

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
