//! Reads `metrics.csv`: the point where a run is resumed, the rows that a resumed run keeps, and the progress of a run.
//! The recorder writes the file, with the columns of `crate::metrics`.

use std::{
    fs::File,
    io::{BufRead, BufReader, Read, Seek, SeekFrom},
    path::Path,
};

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{
    folder::RunFolder,
    table::{Table, read_json, write_atomically},
};
use crate::run_view::Spread;

/// What a run had done before this start: nothing, or what its newest checkpoint says.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ResumePoint {
    /// Updates of the checkpoint.
    pub updates: u64,
    /// Rows from which the checkpoint has learned.
    pub(crate) rows: u64,
    pub(crate) frames: u64,
    /// Whether the replay was kept; it then counts everything that [`BeforeReplay`] does not.
    pub(crate) replay_is_kept: bool,
    /// Updates after which the replay began to count, if it was not kept.
    pub(crate) after_updates: u64,
    /// Frames after which the run now ends.
    pub(crate) frames_max: u64,
}

/// What a run had done before its replay began to count: up to the last resume without a replay, or nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct BeforeReplay {
    /// Updates at which the replay began to count; they identify the replay.
    pub(crate) after_updates: u64,
    pub(crate) rows: u64,
    pub(crate) episodes: u64,
    pub(crate) k: Option<Spread>,
    /// Seconds that the run took up to its last resume, with or without its replay. Rows of metrics that were set aside do not show it.
    pub(crate) seconds: f64,
}

impl BeforeReplay {
    pub(crate) fn read(folder: &RunFolder) -> anyhow::Result<Self> {
        let path = folder.resumed();
        match path.exists() {
            true => read_json(&path),
            false => Ok(Self::default()),
        }
    }

    pub(crate) fn write(&self, folder: &RunFolder) -> anyhow::Result<()> {
        write_atomically(&folder.resumed(), &serde_json::to_vec(self)?)
    }
}

/// The last row lies within this many bytes at the end of the file.
const LAST_ROW_BYTES_MAX: u64 = 1 << 16;

/// The columns that decide whether a resumed run keeps a row.
#[derive(Deserialize)]
struct Counts {
    frames: u64,
    updates: u64,
}

/// Reads the rows of an interrupted run up to `resume_point`, under this header; none without the file. Later rows contradict what the
/// run will do and are set aside. Also returns the seconds that the run has taken, by all rows.
pub(super) fn rows_up_to(
    path: &Path,
    header: Vec<String>,
    resume_point: ResumePoint,
) -> anyhow::Result<(Table, f64)> {
    let mut table = Table::read(path)?;
    let seconds = table.rows.iter();
    let seconds = seconds.filter_map(|row| table.value::<f64>(row, "seconds"));
    let seconds = seconds.fold(0.0, f64::max);
    table.keep_rows(path, |it: Counts| {
        // Actors run ahead: without the limit on frames, a run that now ends sooner would keep rows from after its end. A replay that
        // is filled anew counts from the checkpoint's frames.
        let is_counted = resume_point.replay_is_kept || it.frames <= resume_point.frames;
        is_counted && it.updates <= resume_point.updates && it.frames <= resume_point.frames_max
    })?;
    let columns: Vec<_> = header.iter().map(|name| table.column_index(name)).collect();
    let rows = table.rows.iter().map(|row| {
        let cell = |place: &Option<usize>| place.and_then(|at| row.get(at)).unwrap_or("");
        columns.iter().map(cell).collect()
    });
    let rows = rows.collect();
    Ok((Table { header, rows }, seconds))
}

/// The progress of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
pub struct Progress {
    /// Frames of the last row of metrics.
    pub frames: u64,
    /// Episodes of the last row of metrics.
    pub episodes: u64,
}

/// The progress of the run in `folder`; none before its first row of metrics.
pub fn read_progress(folder: &RunFolder) -> Option<Progress> {
    read_last_row(folder)
}

/// The last row of metrics; none if a column of `T` is empty. Reads only the file's first line and its end.
pub(crate) fn read_last_row<T: DeserializeOwned>(folder: &RunFolder) -> Option<T> {
    let mut file = File::open(folder.metrics()).ok()?;
    let mut header = String::new();
    BufReader::new(&file).read_line(&mut header).ok()?;
    let length = file.metadata().ok()?.len();
    let start = length.saturating_sub(LAST_ROW_BYTES_MAX);
    file.seek(SeekFrom::Start(start)).ok()?;
    let mut end = Vec::new();
    file.read_to_end(&mut end).ok()?;
    let end = String::from_utf8_lossy(&end);
    // Text after the last line break is still being written.
    let row = end.get(..end.rfind('\n')?)?.lines().last()?;
    let last = Table::parse(format!("{header}{row}\n").as_bytes()).ok()?;
    last.parse_rows(&folder.metrics()).ok()?.pop()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::testing::run_folder;

    #[test]
    fn the_last_whole_row_counts() {
        let (_root, folder) = run_folder();
        let write = |text: &str| fs::write(folder.metrics(), text).unwrap();
        assert_eq!(read_progress(&folder), None);
        write("seconds,frames,updates,a,b,c,episodes\n");
        assert_eq!(read_progress(&folder), None);
        let found = Progress {
            frames: 200,
            episodes: 7,
        };
        // Also with the memory of as many processes as a run may have.
        for processes in [3, 512] {
            let [names, memory] =
                [",rss_mib_actor_255", ",12345.678"].map(|it| it.repeat(processes));
            write(&format!(
                "seconds,frames,updates,episodes{names}\n1,200,3,7{memory}\n2,30"
            ));
            assert_eq!(read_progress(&folder), Some(found));
        }
    }
}
