//! A CSV file that grows by rows while a run goes on.

use std::path::Path;

use super::growing_file::GrowingFile;

/// A [`GrowingFile`] of comma-separated rows under a header.
#[derive(Debug)]
pub(super) struct GrowingCsv(GrowingFile);

impl GrowingCsv {
    /// Makes the file anew, with a header and the rows that it begins with.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(super) fn create(
        path: &Path,
        header: &[String],
        rows: &[csv::StringRecord],
    ) -> anyhow::Result<Self> {
        let mut csv = csv::Writer::from_writer(Vec::new());
        csv.write_record(header)?;
        for row in rows {
            csv.write_record(row)?;
        }
        Ok(Self(GrowingFile::create(path, &csv.into_inner()?)?))
    }

    /// Adds a row, after those that wait. A warning is returned the first time that a row has to wait.
    ///
    /// # Panics
    /// If a row cannot be made into text, which takes no file.
    pub(super) fn add(&mut self, row: impl IntoIterator<Item = String>) -> Option<String> {
        self.0.add(text(row))
    }

    /// [`Self::add`] of several rows, in one write.
    ///
    /// # Panics
    /// As [`Self::add`].
    pub(super) fn add_all<const N: usize>(&mut self, rows: Vec<[String; N]>) -> Option<String> {
        self.0.add_all(rows.into_iter().map(text))
    }

    /// What is missing in the file, as [`GrowingFile::missing`] says it.
    pub(super) fn missing(&self) -> Option<String> {
        self.0.missing()
    }
}

/// A row's bytes.
fn text(row: impl IntoIterator<Item = String>) -> Vec<u8> {
    let mut csv = csv::Writer::from_writer(Vec::new());
    let row: Vec<_> = row.into_iter().collect();
    csv.write_record(row).expect("a row in memory");
    csv.into_inner().expect("a row in memory")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_table_begins_with_the_rows_that_it_is_given() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.csv");
        let rows = [csv::StringRecord::from(vec!["1", "2"])];
        let mut table = GrowingCsv::create(&path, &["a".into(), "b".into()], &rows).unwrap();
        table.add(["3".into(), "4, of five".into()]);
        assert_eq!(
            fs::read_to_string(&path).unwrap(),
            "a,b\n1,2\n3,\"4, of five\"\n"
        );
    }
}
