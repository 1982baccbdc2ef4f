//! A file that grows while a run goes on. A full disk never ends the run: what comes waits in memory until it can be
//! written, and only what is still missing at the end, or too much to keep, is lost.

use std::{
    collections::VecDeque,
    fs::File,
    io::{self, Write},
    path::Path,
};

use anyhow::Context;
use driml_protocol::whole_file;

/// Rows that are kept in memory while they cannot be written; of more the oldest are lost. A day of metrics, minutes of the episodes
/// of a world whose episodes take milliseconds.
const WAITING_MAX: usize = 100_000;

/// The file and what is not in it yet.
#[derive(Debug)]
pub(super) struct GrowingFile {
    /// Its name, for messages.
    name: String,
    file: File,
    /// Bytes of it that are whole rows.
    length: u64,
    waiting: VecDeque<Vec<u8>>,
    lost: u64,
    /// The first error.
    failed: Option<io::Error>,
}

impl GrowingFile {
    /// Makes the file anew, with the bytes that it begins with.
    ///
    /// # Errors
    /// A file system that refuses.
    pub(super) fn create(path: &Path, first: &[u8]) -> anyhow::Result<Self> {
        let doing = || format!("writing {}", path.display());
        whole_file::write(path, first).with_context(doing)?;
        let file = File::options()
            .append(true)
            .open(path)
            .with_context(doing)?;
        let name = path.file_name().unwrap_or_default();
        Ok(Self {
            name: name.to_string_lossy().into_owned(),
            file,
            length: first.len() as u64,
            waiting: VecDeque::new(),
            lost: 0,
            failed: None,
        })
    }

    /// Adds a row, after those that wait. A warning is returned the first time that a row has to wait.
    pub(super) fn add(&mut self, row: Vec<u8>) -> Option<String> {
        self.add_all([row])
    }

    /// [`Self::add`] of several rows, in one write.
    pub(super) fn add_all(&mut self, rows: impl IntoIterator<Item = Vec<u8>>) -> Option<String> {
        self.waiting.extend(rows);
        let more = self.waiting.len().saturating_sub(WAITING_MAX);
        self.waiting.drain(..more);
        self.lost += more as u64;
        let error = self.write().err()?;
        let said = self.failed.is_none().then(|| {
            format!(
                "{} cannot be written: {error}; the run goes on, and its rows are written once that is possible",
                self.name
            )
        });
        self.failed.get_or_insert(error);
        said
    }

    /// Writes all rows that wait, or none.
    fn write(&mut self) -> io::Result<()> {
        let bytes = self.waiting.make_contiguous().concat();
        if let Err(e) = self.file.write_all(&bytes) {
            // Half a row may be there. Should this fail too, the next try begins with half a row before it.
            let _ = self.file.set_len(self.length);
            return Err(e);
        }
        self.length += bytes.len() as u64;
        self.waiting.clear();
        Ok(())
    }

    /// How many rows are not in the file, and why; none if all are.
    pub(super) fn missing(&self) -> Option<String> {
        let rows = self.lost + self.waiting.len() as u64;
        let error = self.failed.as_ref().filter(|_| rows > 0)?;
        Some(format!("{rows} rows of {} are lost: {error}", self.name))
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// A file on a full disk.
    fn full(path: &Path) -> GrowingFile {
        let mut table = GrowingFile::create(path, b"a\n").unwrap();
        table.file = File::options().append(true).open("/dev/full").unwrap();
        table
    }

    #[test]
    fn rows_wait_until_they_can_be_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.csv");
        let mut table = full(&path);
        let row = |n: u32| format!("\"{n}, of five\"\n").into_bytes();
        let said = table.add(row(1)).unwrap();
        assert!(
            said.starts_with("metrics.csv cannot be written: No space left"),
            "{said}"
        );
        assert_eq!(table.add(row(2)), None, "it is said once");
        let missing = table.missing().unwrap();
        assert!(
            missing.starts_with("2 rows of metrics.csv are lost: "),
            "{missing}"
        );

        table.file = File::options().append(true).open(&path).unwrap();
        assert_eq!((table.add(row(3)), table.missing()), (None, None));
        let text = fs::read_to_string(&path).unwrap();
        assert_eq!(text, "a\n\"1, of five\"\n\"2, of five\"\n\"3, of five\"\n");
        assert_eq!(table.length, text.len() as u64);
    }

    #[test]
    fn the_oldest_of_too_many_rows_are_lost() {
        let folder = tempfile::tempdir().unwrap();
        let mut table = full(&folder.path().join("x.csv"));
        table.waiting = vec![Vec::new(); WAITING_MAX - 1].into();
        table.add(b"1".to_vec());
        table.add(b"2".to_vec());
        assert_eq!((table.lost, table.waiting.len()), (1, WAITING_MAX));
    }
}
