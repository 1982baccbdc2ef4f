//! A table of the run folder: a CSV file whose columns are read by name, and a log to which a run appends rows.
//! A full disk never ends the run: rows wait in memory until they can be written. Only rows that still wait at the end, or that are
//! too many to keep, are lost.

use std::{
    collections::VecDeque,
    fs::{self, File},
    io::{self, ErrorKind, Write},
    path::{Path, PathBuf},
    str::FromStr,
};

use anyhow::Context;
use csv::StringRecord;
use driml_machine::{
    error::{Usage, usage},
    units::count,
};
use driml_protocol::atomic_write;
use serde::de::DeserializeOwned;

use crate::console;

/// Maximum number of rows kept in memory while they cannot be written; beyond it the oldest are lost. It suffices for a day of
/// metrics, or for minutes in a world whose episodes take milliseconds.
const WAITING_MAX: usize = 100_000;

/// Writes a file whole or not at all.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    atomic_write::write(path, bytes).with_context(|| format!("writing {}", path.display()))
}

pub(super) fn read_json<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let doing = || format!("reading {}", path.display());
    let text = fs::read(path).with_context(doing)?;
    serde_json::from_slice(&text).with_context(doing)
}

/// The complete rows of a CSV file that a run writes.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// The names of the columns.
    pub header: Vec<String>,
    /// A record for each row, without the header.
    pub rows: Vec<StringRecord>,
}

impl Table {
    /// Parses a file's text. Text after the last line break is left out: it was cut off, or a process still writes it.
    pub fn parse(text: &[u8]) -> Result<Self, csv::Error> {
        let whole = text.iter().rposition(|&byte| byte == b'\n');
        let mut reader = csv::Reader::from_reader(&text[..whole.map_or(0, |end| end + 1)]);
        let header = reader.headers()?.iter().map(String::from).collect();
        let rows = reader.records().collect::<Result<_, _>>()?;
        Ok(Self { header, rows })
    }

    /// Reads the file at `path`; a missing file gives an empty table.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let reading = || format!("reading {}", path.display());
        match fs::read(path) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(Self::default()),
            text => Self::parse(&text.with_context(reading)?)
                .map_err(|e| usage!("{}: {e}; correct or remove that line", path.display()).into()),
        }
    }

    /// The index of the column `name`; none if the table does not have it.
    pub fn column_index(&self, name: &str) -> Option<usize> {
        self.header.iter().position(|it| it == name)
    }

    /// The value of `row` in the column `name`; none if the cell is empty, or of another type.
    pub fn value<T: FromStr>(&self, row: &StringRecord, name: &str) -> Option<T> {
        row.get(self.column_index(name)?)?.parse().ok()
    }

    /// The value of the last row in the column `name`.
    pub fn last<T: FromStr>(&self, name: &str) -> Option<T> {
        self.value(self.rows.last()?, name)
    }

    pub(super) fn to_csv(&self) -> Vec<u8> {
        let rows = self.rows.iter().flat_map(csv_row);
        csv_row(&self.header).into_iter().chain(rows).collect()
    }

    /// The rows as `T`, whose fields have the names of the columns. The error names the file at `path` and the row that does not fit.
    pub(super) fn parse_rows<T: DeserializeOwned>(&self, path: &Path) -> Result<Vec<T>, Usage> {
        let header = StringRecord::from(&self.header[..]);
        let parse = |row: &StringRecord| {
            row.deserialize(Some(&header)).map_err(|_| {
                let of = path.file_stem().unwrap_or_default().display();
                let row = row.iter().collect::<Vec<_>>().join(",");
                let path = path.display();
                usage!("{path}: {row:?} is not a row of {of}: correct or remove it")
            })
        };
        self.rows.iter().map(parse).collect()
    }

    /// Keeps the rows for which `is_kept` returns true. The others are written into a new file beside `path`, which a printed line
    /// names. Returns whether there were any others.
    pub(super) fn keep_rows<T: DeserializeOwned>(
        &mut self,
        path: &Path,
        is_kept: impl Fn(T) -> bool,
    ) -> anyhow::Result<bool> {
        let parsed = self.parse_rows(path)?;
        let mut set_aside = Self {
            header: self.header.clone(),
            rows: Vec::new(),
        };
        for (row, parsed) in std::mem::take(&mut self.rows).into_iter().zip(parsed) {
            match is_kept(parsed) {
                true => self.rows.push(row),
                false => set_aside.rows.push(row),
            }
        }
        if set_aside.rows.is_empty() {
            return Ok(false);
        }
        let aside_path = aside_path(path);
        write_atomically(&aside_path, &set_aside.to_csv())?;
        let name = |path: &Path| path.file_name().unwrap_or_default().display().to_string();
        console::eprintln(&format!(
            "{} of {} past the point where the run is resumed: moved to {}",
            count(set_aside.rows.len(), "row"),
            name(path),
            name(&aside_path)
        ));
        Ok(true)
    }
}

#[derive(Debug)]
pub(crate) struct AppendLog {
    name: String,
    /// The word for one entry: row or line.
    unit: &'static str,
    file: File,
    waiting: VecDeque<Vec<u8>>,
    waiting_max: usize,
    lost: u64,
    error: Option<io::Error>,
}

impl AppendLog {
    pub(super) fn create(path: &Path, first: &[u8]) -> anyhow::Result<Self> {
        write_atomically(path, first)?;
        let name = path.file_name().unwrap_or_default();
        Self::open(path, name.to_string_lossy().into(), "row", WAITING_MAX)
    }

    /// Opens a file to append, or makes it. Messages call it `name`, and an entry `unit`; at most `waiting_max` entries wait.
    pub(crate) fn open(
        path: &Path,
        name: String,
        unit: &'static str,
        waiting_max: usize,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            name,
            unit,
            file: open_to_append(path)?,
            waiting: VecDeque::new(),
            waiting_max,
            lost: 0,
            error: None,
        })
    }

    /// Adds rows after those that wait, in one write. Returns a warning the first time that rows have to wait.
    pub(crate) fn add(&mut self, rows: impl IntoIterator<Item = Vec<u8>>) -> Option<String> {
        self.waiting.extend(rows);
        let excess = self.waiting.len().saturating_sub(self.waiting_max);
        self.waiting.drain(..excess);
        self.lost += excess as u64;
        let error = self.write().err()?;
        let (name, unit) = (&self.name, self.unit);
        let warning = self.error.is_none().then(|| {
            format!("{name} cannot be written: {error}; its {unit}s wait in memory until it can be")
        });
        self.error.get_or_insert(error);
        warning
    }

    fn write(&mut self) -> io::Result<()> {
        append(&mut self.file, &self.waiting.make_contiguous().concat())?;
        self.waiting.clear();
        Ok(())
    }

    /// How many rows are not in the file, and why; none if all are in it.
    pub(crate) fn loss_message(&self) -> Option<String> {
        let lost = self.lost + self.waiting.len() as u64;
        let error = self.error.as_ref().filter(|_| lost > 0)?;
        let (name, lost) = (&self.name, count(lost, self.unit));
        Some(format!("lost {lost} of {name}: {error}"))
    }
}

/// An unused path beside `path` for its earlier content, such as `metrics.aside-1.csv`.
pub(super) fn aside_path(path: &Path) -> PathBuf {
    let extension = path.extension().unwrap_or_default().display();
    let name = |n: u32| path.with_extension(format!("aside-{n}.{extension}"));
    let free = (1..).map(name).find(|it| !it.exists());
    free.expect("numbers do not end")
}

pub(super) fn open_to_append(path: &Path) -> anyhow::Result<File> {
    let file = File::options().create(true).append(true).open(path);
    file.with_context(|| format!("writing {}", path.display()))
}

/// Appends all bytes to a file, or none.
pub(super) fn append(file: &mut File, bytes: &[u8]) -> io::Result<()> {
    let before = file.metadata()?.len();
    let written = file.write_all(bytes);
    if written.is_err() {
        // Remove a row that was written in part. If that fails too, the next row follows this part.
        let _ = file.set_len(before);
    }
    written
}

/// Formats a row of a CSV file as bytes.
pub(super) fn csv_row<T: AsRef<[u8]>>(cells: impl IntoIterator<Item = T>) -> Vec<u8> {
    let mut csv = csv::Writer::from_writer(Vec::new());
    csv.write_record(cells).expect("a row in memory");
    csv.into_inner().expect("a row in memory")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_found_by_name_in_whole_rows_alone() {
        let read = Table::parse(b"frames,loss\n1,\n2,0.5\n3,0.2").unwrap();
        assert_eq!(read.rows.len(), 2);
        let last = (read.last("frames"), read.last("loss"));
        assert_eq!(last, (Some(2), Some(0.5)));
        assert_eq!(read.value::<f64>(&read.rows[0], "loss"), None);
        assert_eq!(read.last::<u64>("k"), None);
        assert!(Table::parse(b"frames,lo").unwrap().header.is_empty());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.csv");
        fs::write(&path, "frames,loss\n1\n").unwrap();
        let said = Table::read(&path).unwrap_err().to_string();
        assert!(said.ends_with("; correct or remove that line"), "{said}");
    }

    #[test]
    fn what_is_appended_waits_until_it_can_be_written() {
        let folder = tempfile::tempdir().unwrap();
        let text = |n: u64| format!("\"{n}, of five\"\n");
        let row = |n| [text(n).into_bytes()];
        for (name, unit, waiting_max, lost) in [
            ("metrics.csv", "row", WAITING_MAX, 0),
            ("the log of actor-0", "line", 2, 1),
        ] {
            let full = Path::new("/dev/full");
            let mut log = AppendLog::open(full, name.into(), unit, waiting_max).unwrap();
            let said = log.add(row(1)).unwrap();
            let why = format!("{name} cannot be written: No space left");
            let wait = format!("; its {unit}s wait in memory until it can be");
            assert!(said.starts_with(&why) && said.ends_with(&wait), "{said}");
            assert_eq!(log.add(row(2)), None, "it is logged once");
            let missing = log.loss_message().unwrap();
            let why = format!("lost 2 {unit}s of {name}: No space left");
            assert!(missing.starts_with(&why), "{missing}");

            let path = folder.path().join(unit);
            fs::write(&path, "a\n").unwrap();
            log.file = File::options().append(true).open(&path).unwrap();
            // If more rows wait than may, the oldest are lost.
            assert_eq!(log.add(row(3)), None);
            let kept: String = (1 + lost..=3).map(text).collect();
            assert_eq!(fs::read_to_string(&path).unwrap(), format!("a\n{kept}"));
            assert_eq!((log.lost, log.loss_message().is_some()), (lost, lost > 0));
        }
    }
}
