//! The cache of an experiment: its folder with finished pieces of work, from which it resumes, and with its data and figures.
//! Each experiment decides what a piece is and what follows from all pieces. `sweep::runs` keeps whole runs.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    time::{Instant, SystemTime},
};

use anyhow::{Context, bail, ensure};
use driml_figure::{Figure, Format, Look};
use driml_launch::{
    console::{self, print_wrapped},
    output,
};
use driml_machine::{
    error::{Interrupted, usage},
    process_env,
    resources::{self, Machine},
};
use driml_protocol::{GracefulShutdown, config::first_difference};
use minijinja::{Value, context};
use serde::{
    Deserialize, Serialize,
    de::{DeserializeOwned, IgnoredAny},
};

use crate::{
    flags::ExperimentFlags,
    page::{describe_time, render_page, summary},
    progress::Progress,
};

/// The subfolder with the finished pieces, one file each, and the settings that made them. Git ignores it.
const PIECES: &str = "pieces";
const SETTINGS: &str = "settings.json";
/// The piece with the number of cores of the machine that does the work.
const CORES: &str = "cores";
/// The subfolder with the runs of a sweep. Git ignores it.
pub(crate) const RUNS: &str = "runs";

/// Returns `text` as the name of a file: each unsuitable character, such as one of a world's command, becomes a dash.
pub(crate) fn file_name(text: &str) -> String {
    let is_allowed = |letter: char| letter.is_ascii_alphanumeric() || "-_=.+".contains(letter);
    let letters = text.chars().map(|it| if is_allowed(it) { it } else { '-' });
    letters.collect()
}

#[derive(Serialize, Deserialize)]
struct StoredPiece<T> {
    /// What the piece was made from, such as the hash of weights; empty if it depends on the settings alone.
    #[serde(default)]
    of: String,
    seconds: f64,
    result: T,
}

/// The open folder of an experiment, with its progress and the time of its pieces.
#[derive(Debug)]
pub(crate) struct Session {
    pub(crate) folder: PathBuf,
    smoke: bool,
    pub(crate) report_only: bool,
    pub(crate) progress: Progress,
    /// The time of each piece by its key, and of all runs together.
    seconds: BTreeMap<String, f64>,
    /// How many runs were made at once.
    jobs: u32,
    /// The names of the runs that are planned and not finished.
    missing: Vec<String>,
}

impl Session {
    /// Opens or creates the folder. `units` is the work of all pieces together; `sweep::queue` adds the work of runs. With `report_only`
    /// the folder must have pieces or runs, and the settings are not written because they made nothing.
    pub(crate) fn open(
        name: &str,
        flags: &ExperimentFlags,
        settings: &impl Serialize,
        units: u64,
        report_only: bool,
    ) -> anyhow::Result<Self> {
        let folder = folder(name, flags);
        let has = |what| folder.join(what).is_dir();
        if report_only && !has(PIECES) && !has(RUNS) {
            let folder = folder.display();
            bail!(usage!(
                "{folder} has no results yet: run the same command without --report first"
            ));
        }
        let pieces = folder.join(PIECES);
        output::make_folder("--out", &pieces)?;
        let settings = serde_json::to_string_pretty(settings).context("encoding the settings")?;
        let path = pieces.join(SETTINGS);
        match fs::read(&path) {
            Ok(found) if found == settings.as_bytes() => {}
            Ok(found) => bail!(usage!(
                "{} holds results made with {}: choose another --out, or remove that folder",
                folder.display(),
                describe_change(&found, settings.as_bytes())
            )),
            Err(_) if report_only => {}
            Err(_) => output::write_file("--out", &path, settings.as_bytes())?,
        }
        let shutdown = GracefulShutdown::on_repeated_signals(None);
        let shutdown = shutdown.context("listening for interrupts")?;
        let session = Self {
            folder,
            smoke: flags.smoke,
            report_only,
            progress: Progress::new(units, shutdown),
            seconds: BTreeMap::new(),
            jobs: 1,
            missing: Vec::new(),
        };
        if !report_only {
            session.store(CORES, Machine::detect().cores)?;
        }
        Ok(session)
    }

    /// Removes the stored settings, so that a later call may choose others. The pieces must name what they were made from.
    pub(crate) fn forget_settings(&self) -> anyhow::Result<()> {
        let path = self.folder.join(PIECES).join(SETTINGS);
        fs::remove_file(&path).with_context(|| format!("removing {}", path.display()))
    }

    /// Returns the piece of this name if it exists and can be read, whatever it was made from.
    pub(crate) fn read_piece<T: DeserializeOwned>(&self, key: &str) -> Option<T> {
        self.read(key).map(|piece| piece.result)
    }

    pub(crate) fn store<T: Serialize>(&self, key: &str, result: T) -> anyhow::Result<()> {
        let piece = StoredPiece {
            of: String::new(),
            seconds: 0.0,
            result,
        };
        self.write(key, &piece)
    }

    fn read<T: DeserializeOwned>(&self, key: &str) -> Option<StoredPiece<T>> {
        let text = fs::read(self.piece_path(key)).ok()?;
        serde_json::from_slice(&text).ok()
    }

    fn write(&self, key: &str, piece: &StoredPiece<impl Serialize>) -> anyhow::Result<()> {
        let text = serde_json::to_vec(piece).context("encoding a piece")?;
        Ok(output::write_file("--out", &self.piece_path(key), &text)?)
    }

    fn piece_path(&self, key: &str) -> PathBuf {
        let name = file_name(&format!("{key}.json"));
        self.folder.join(PIECES).join(name)
    }

    /// Counts runs, which `sweep::runs` keeps: the time of all of them together, how many were made at once, and the names of the
    /// unfinished ones.
    pub(crate) fn count_runs(&mut self, seconds: f64, jobs: u32, missing: Vec<String>) {
        self.seconds.insert(RUNS.to_owned(), seconds);
        self.jobs = jobs;
        self.missing = missing;
    }

    /// Returns an error if a run is missing, unless this session only reports.
    pub(crate) fn check_none_missing(&self) -> anyhow::Result<()> {
        ensure!(
            self.missing.is_empty() || self.report_only,
            "these runs failed and are not on the page; the same command retries them: {}",
            self.missing.join(", ")
        );
        Ok(())
    }

    pub(crate) fn check_has_runs<T>(&self, made: &[T]) -> anyhow::Result<()> {
        if made.is_empty() {
            self.check_none_missing()?;
            bail!(usage!(
                "no run is finished yet: run the same command without --report first"
            ));
        }
        Ok(())
    }

    /// Returns the piece of this name, `units` of work: reads it if it exists, else makes and keeps it. `source` names what the piece is
    /// made from, empty if from the settings alone. If `source` has changed since, the piece is made again.
    pub(crate) fn load_or_make<T: Serialize + DeserializeOwned>(
        &mut self,
        source: &str,
        key: &str,
        units: u64,
        make: impl FnOnce(&mut Progress) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        // A piece that cannot be read is made again, like a missing one.
        if let Some(piece) = self.read::<T>(key).filter(|piece| piece.of == source) {
            self.progress.count_earlier(units);
            self.seconds.insert(key.to_owned(), piece.seconds);
            return Ok(piece.result);
        }
        let report_stop = |e: &anyhow::Error| {
            if e.is::<Interrupted>() {
                console::eprintln("stopped; the same command resumes after the last whole piece");
            }
        };
        self.progress.set_task(key);
        let (started, before) = (Instant::now(), self.progress.done());
        let piece = StoredPiece {
            result: make(&mut self.progress).inspect_err(report_stop)?,
            of: source.to_owned(),
            seconds: started.elapsed().as_secs_f64(),
        };
        self.write(key, &piece)?;
        self.seconds.insert(key.to_owned(), piece.seconds);
        // Counts the units that `make` did not count. This comes after the write, so that an interrupt here does not lose the piece.
        let rest = units.saturating_sub(self.progress.done() - before);
        let counted = self.progress.advance(rest).map_err(anyhow::Error::from);
        counted.inspect_err(report_stop)?;
        Ok(piece.result)
    }

    /// Like [`Session::load_or_make`] for what this program computes from `inputs`. For a report, pieces of other programs are valid too.
    pub(crate) fn load_or_compute<T: Serialize + DeserializeOwned>(
        &mut self,
        inputs: &str,
        key: &str,
        units: u64,
        make: impl FnOnce(&mut Progress) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let piece = self.read::<IgnoredAny>(key).map(|piece| piece.of);
        let source = match piece.filter(|source| self.report_only && source.starts_with(inputs)) {
            Some(source) => source,
            None => format!("{inputs}, {}", program_id()?),
        };
        self.load_or_make(&source, key, units, make)
    }

    /// Writes rows as `name.csv` below a header. `columns` are the column names, separated by commas.
    pub(crate) fn write_csv<R: Serialize>(
        &self,
        name: &str,
        columns: &str,
        rows: impl IntoIterator<Item = R>,
    ) -> anyhow::Result<()> {
        let mut table = csv::Writer::from_writer(Vec::new());
        table.write_record(columns.split(','))?;
        for row in rows {
            table.serialize(row)?;
        }
        let path = self.folder.join(format!("{name}.csv"));
        Ok(output::write_file("--out", &path, &table.into_inner()?)?)
    }

    pub(crate) fn save_figure(&self, stem: &str, figure: &Figure) -> anyhow::Result<()> {
        for (extension, format) in [("svg", Format::Svg), ("png", Format::Png)] {
            let path = self.folder.join(format!("{stem}.{extension}"));
            output::write_file("--out", &path, &figure.encode(format, Look::Card)?)?;
        }
        Ok(())
    }

    /// Fills the page template with these values and the `missing` runs, writes the page and prints its path. Returns an error if a run
    /// failed and is therefore not on the page.
    pub(crate) fn write_page(self, template: &str, values: Value) -> anyhow::Result<()> {
        self.progress.clear();
        let seconds = self.seconds.values().sum();
        let time = describe_time(seconds, self.jobs, self.read_piece(CORES));
        let values = context! { missing => self.missing, ..values };
        let text = render_page(template, values, self.smoke, &time);
        let path = self.folder.join("README.md");
        output::write_file("--out", &path, text.as_bytes())?;
        print_wrapped(&format!("{}{}\n", summary(&text), path.display()), 2)?;
        self.check_none_missing()
    }
}

/// Returns the settings that made the experiment's pieces; `None` if there are none yet or they cannot be read.
pub(crate) fn settings_of<T: DeserializeOwned>(name: &str, flags: &ExperimentFlags) -> Option<T> {
    let text = fs::read_to_string(folder(name, flags).join(PIECES).join(SETTINGS)).ok()?;
    serde_json::from_str(&text).ok()
}

/// Names the first setting that differs, with both values.
fn describe_change(before: &[u8], now: &[u8]) -> String {
    let [before, now] = [before, now].map(|it| serde_json::from_slice(it).unwrap_or_default());
    match first_difference("", &before, &now) {
        None => "other settings".into(),
        Some((path, before, now)) => {
            let path = path.trim_start_matches('.');
            format!("{path} = {before}, not {now}")
        }
    }
}

pub(crate) fn folder(name: &str, flags: &ExperimentFlags) -> PathBuf {
    let suffix = if flags.smoke { "-smoke" } else { "" };
    let default = || Path::new("experiments").join(format!("{name}{suffix}"));
    flags.out.clone().unwrap_or_else(default)
}

/// Identifies this program and its processor, for [`Session::load_or_compute`]: the size and modification time of its file, and the model.
fn program_id() -> anyhow::Result<String> {
    let file = process_env::program_path();
    let metadata = fs::metadata(&file).with_context(|| format!("looking at {}", file.display()))?;
    let modified = metadata.modified().ok();
    let modified = modified.and_then(|it| it.duration_since(SystemTime::UNIX_EPOCH).ok());
    Ok(format!(
        "{} bytes of {} s, {}",
        metadata.len(),
        modified.map_or(0.0, |it| it.as_secs_f64()),
        resources::processor_name()
    ))
}

#[cfg(test)]
mod tests {
    use driml_machine::error::Usage;

    use super::*;
    use crate::flags::tests::parse;

    #[test]
    fn a_piece_is_made_once_and_other_settings_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let flags = parse(&format!("--smoke --out {}/walk", folder.path().display()));
        let open = |settings: &str| Session::open("walk", &flags, &settings, 40, false);
        let report = |settings: &str| Session::open("walk", &flags, &settings, 40, true);
        assert!(report("a").unwrap_err().is::<Usage>());
        assert!(!folder.path().join("walk").exists());
        // A folder with copied runs, opened with wrong flags: the flags are not stored.
        fs::create_dir_all(folder.path().join("walk/runs")).unwrap();
        let copied = report("wrong").unwrap();
        assert_eq!(copied.read_piece::<u32>(CORES), None, "of another machine");
        let mut session = open("a").unwrap();
        assert_eq!(session.load_or_make("", "one", 2, |_| Ok(7)).unwrap(), 7);
        let failed = session.load_or_make::<u32>("", "two", 2, |_| bail!("stopped"));
        assert!(failed.is_err());

        let made = |key: &str, made: u32| open("a").unwrap().load_or_make("", key, 2, |_| Ok(made));
        assert_eq!(made("one", 8).unwrap(), 7, "it is kept");
        assert_eq!(made("two", 8).unwrap(), 8);
        // A crash of the machine cut the file off in the middle of a write.
        fs::write(folder.path().join("walk/pieces/one.json"), "{\"seconds\":").unwrap();
        assert_eq!(made("one", 9).unwrap(), 9);
        assert!(open("b").unwrap_err().is::<Usage>());
        // The source of the piece has changed.
        let mut of = |of: &str, n: u32| session.load_or_make(of, "played", 1, |_| Ok(n)).unwrap();
        let all = [of("x", 1), of("x", 2), of("y", 3), of("y", 4)];
        assert_eq!(all, [1, 1, 3, 3]);
        // `read_piece` reads a piece whatever it was made from.
        assert_eq!(session.read_piece::<u32>("played"), Some(3));
        assert_eq!(session.read_piece::<u32>("never"), None);
        let mut reported = report("a").unwrap();
        let cores = reported.read_piece(CORES);
        assert_eq!(cores, Some(Machine::detect().cores));
        let made = session.load_or_make("w, an old program", "errors", 1, |_| Ok(1));
        assert_eq!(made.unwrap(), 1);
        // A piece that several runs use is made once, and its time counts once.
        let seconds: f64 = session.seconds.values().sum();
        session
            .load_or_make("w, an old program", "errors", 1, |_| Ok(2))
            .unwrap();
        assert_eq!(session.seconds.values().sum::<f64>(), seconds);
        let computed = |session: &mut Session, of: &str, n: u32| {
            session.load_or_compute(of, "errors", 1, |_| Ok(n)).unwrap()
        };
        assert_eq!(computed(&mut reported, "w", 2), 1);
        assert_eq!(computed(&mut session, "w", 3), 3);
        assert_eq!(computed(&mut reported, "v", 4), 4);
        assert!(report("b").unwrap_err().is::<Usage>());
        // Ctrl-C while a piece is made: the piece is kept first.
        let stopped = session.load_or_make("", "slow", 1, |progress| {
            nix::sys::signal::raise(nix::sys::signal::Signal::SIGINT)?;
            progress.shutdown.drain.wait();
            Ok(5)
        });
        assert!(stopped.unwrap_err().is::<Interrupted>());
        assert_eq!(session.read_piece::<u32>("slow"), Some(5));
        // Failed runs are not a usage error.
        for (session, is_usage) in [(&mut session, false), (&mut reported, true)] {
            session.count_runs(0.0, 1, vec!["a".into()]);
            let said = session.check_has_runs::<u32>(&[]).unwrap_err();
            assert_eq!(said.is::<Usage>(), is_usage);
            assert_eq!(said.to_string().ends_with(": a"), !is_usage);
            assert_eq!(session.check_none_missing().is_ok(), is_usage);
        }
    }
}
