//! The cache of an experiment: its folder with finished pieces of work, from which it resumes, its data and its figures.
//! It knows no experiment; what a piece is and what follows from all of them is theirs. Whole runs are kept by `sweep::runs`.

use std::{
    fs,
    path::{Path, PathBuf},
    time::{Instant, SystemTime},
};

use anyhow::{Context, bail, ensure};
use driml_figure::{Figure, Look};
use driml_launch::{
    console::{self, print},
    run_folder::write_whole,
};
use driml_machine::{
    error::{Interrupted, usage},
    process_env,
    resources::{self, Machine},
};
use driml_protocol::GracefulShutdown;
use minijinja::{Value, context};
use serde::{
    Deserialize, Serialize,
    de::{DeserializeOwned, IgnoredAny},
};

use crate::{
    flags::ExperimentFlags,
    page::{page, summary, time},
    progress::Progress,
};

/// Finished pieces, one file each, and the settings they were made with. Git does not keep it.
const PIECES: &str = "pieces";
const SETTINGS: &str = "settings.json";
/// The piece with how many cores this machine has, if that is where work is done.
const CORES: &str = "cores";
/// Where the runs of a sweep lie. Git does not keep them.
pub(crate) const RUNS: &str = "runs";

/// A finished piece on the disk.
#[derive(Serialize, Deserialize)]
struct Kept<T> {
    /// Of what it was made, such as the hash of weights; empty if of the settings alone.
    #[serde(default)]
    of: String,
    seconds: f64,
    result: T,
}

/// An experiment under way.
#[derive(Debug)]
pub(crate) struct Session {
    folder: PathBuf,
    smoke: bool,
    report_only: bool,
    progress: Progress,
    seconds: f64,
    /// Of how many pieces at once this is the sum.
    at_once: u32,
    /// Runs that are planned and not finished.
    missing: Vec<String>,
}

impl Session {
    /// Opens the folder, or makes it. `units` is the work of all pieces together; runs announce their own. A report alone
    /// needs runs with their calls; it writes down no settings, as they made nothing.
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
                "nothing was made in {folder} yet: there is nothing to report"
            ));
        }
        let pieces = folder.join(PIECES);
        fs::create_dir_all(&pieces).with_context(|| format!("making {}", pieces.display()))?;
        let settings =
            serde_json::to_string_pretty(settings).context("writing down the settings")?;
        let path = pieces.join(SETTINGS);
        match fs::read(&path) {
            Ok(found) if found == settings.as_bytes() => {}
            Ok(_) => bail!(usage!(
                "{} holds what was made with other settings: choose another --out, or remove that folder",
                folder.display()
            )),
            Err(_) if report_only => {}
            Err(_) => write_whole(&path, settings.as_bytes())?,
        }
        let shutdown = GracefulShutdown::on_repeated_signals(None);
        let shutdown = shutdown.context("listening for interrupts")?;
        let session = Self {
            folder,
            smoke: flags.smoke,
            report_only,
            progress: Progress::new(units, shutdown),
            seconds: 0.0,
            at_once: 1,
            missing: Vec::new(),
        };
        if !report_only {
            session.keep(CORES, Machine::this().cores)?;
        }
        Ok(session)
    }

    /// The piece of this name if it is there and can be read, whatever it was made of.
    pub(crate) fn kept_piece<T: DeserializeOwned>(&self, key: &str) -> Option<T> {
        self.read(key).map(|kept| kept.result)
    }

    /// Keeps a piece that took no time.
    pub(crate) fn keep<T: Serialize>(&self, key: &str, result: T) -> anyhow::Result<()> {
        let kept = Kept {
            of: String::new(),
            seconds: 0.0,
            result,
        };
        self.write(key, &kept)
    }

    fn read<T: DeserializeOwned>(&self, key: &str) -> Option<Kept<T>> {
        let text = fs::read(self.piece_path(key)).ok()?;
        serde_json::from_slice(&text).ok()
    }

    fn write<T: Serialize>(&self, key: &str, kept: &Kept<T>) -> anyhow::Result<()> {
        let text = serde_json::to_vec(kept).context("keeping a piece")?;
        write_whole(&self.piece_path(key), &text)
    }

    fn piece_path(&self, key: &str) -> PathBuf {
        self.folder.join(PIECES).join(format!("{key}.json"))
    }

    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    pub(crate) const fn progress(&mut self) -> &mut Progress {
        &mut self.progress
    }

    /// Whether only what is there is reported.
    pub(crate) const fn report_only(&self) -> bool {
        self.report_only
    }

    /// Counts runs, which are kept elsewhere: the time of all together, made `at_once` at a time, and the names of those that are not
    /// finished.
    pub(crate) fn count_runs(&mut self, seconds: f64, at_once: u32, missing: Vec<String>) {
        self.seconds += seconds;
        self.at_once = at_once;
        self.missing = missing;
    }

    /// Makes sure that no run is missing, unless a report of what there is was asked for.
    pub(crate) fn check_made(&self) -> anyhow::Result<()> {
        ensure!(
            self.missing.is_empty() || self.report_only,
            "these runs failed and are in no number of the page; the same command tries them again: {}",
            self.missing.join(", ")
        );
        Ok(())
    }

    /// Makes sure that there is something to report of these finished runs.
    pub(crate) fn check_any<T>(&self, made: &[T]) -> anyhow::Result<()> {
        if made.is_empty() {
            self.check_made()?;
            bail!(usage!("no run is finished yet: there is nothing to report"));
        }
        Ok(())
    }

    /// The piece of this name, which is `units` of work: read if it is there, else made and kept. `of` names what it is made of, which may
    /// have changed since, and then it is made anew; nothing if it is made of the settings alone.
    pub(crate) fn piece_of<T: Serialize + DeserializeOwned>(
        &mut self,
        of: &str,
        key: &str,
        units: u64,
        make: impl FnOnce(&mut Progress) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        // A piece that cannot be read is made again.
        if let Some(kept) = self.read::<T>(key).filter(|kept| kept.of == of) {
            self.progress.find(units);
            self.seconds += kept.seconds;
            return Ok(kept.result);
        }
        let stopped = |e: &anyhow::Error| {
            if e.is::<Interrupted>() {
                console::line("stopped; the same command resumes after the last whole piece");
            }
        };
        self.progress.begin(key);
        let (started, before) = (Instant::now(), self.progress.done());
        let result = make(&mut self.progress).inspect_err(stopped)?;
        let kept = Kept {
            of: of.into(),
            seconds: started.elapsed().as_secs_f64(),
            result,
        };
        self.write(key, &kept)?;
        self.seconds += kept.seconds;
        // What it has not counted itself; only now, so that an interrupt finds the piece kept.
        let rest = units.saturating_sub(self.progress.done() - before);
        let counted = self.progress.advance(rest).map_err(anyhow::Error::from);
        counted.inspect_err(stopped)?;
        Ok(kept.result)
    }

    /// [`Session::piece_of`] what this program makes of `what`: another program's is made anew, but for a report.
    pub(crate) fn computed<T: Serialize + DeserializeOwned>(
        &mut self,
        what: &str,
        key: &str,
        units: u64,
        make: impl FnOnce(&mut Progress) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let kept = self.read::<IgnoredAny>(key).map(|kept| kept.of);
        let of = match kept.filter(|of| self.report_only && of.starts_with(what)) {
            Some(of) => of,
            None => format!("{what}, {}", program()?),
        };
        self.piece_of(&of, key, units, make)
    }

    /// Writes rows as `name.csv`, below the names of their columns, parted by commas.
    pub(crate) fn csv<R: Serialize>(
        &self,
        name: &str,
        columns: &str,
        rows: impl IntoIterator<Item = R>,
    ) -> anyhow::Result<()> {
        let path = self.folder.join(format!("{name}.csv"));
        let doing = || format!("writing {}", path.display());
        let mut file = csv::Writer::from_path(&path).with_context(doing)?;
        file.write_record(columns.split(',')).with_context(doing)?;
        for row in rows {
            file.serialize(row).with_context(doing)?;
        }
        file.flush().with_context(doing)
    }

    /// Writes the figure as `stem.svg` and `stem.png`.
    pub(crate) fn figure(&self, stem: &str, figure: &Figure) -> anyhow::Result<()> {
        for extension in ["svg", "png"] {
            let path = self.folder.join(format!("{stem}.{extension}"));
            figure.save(&path, Look::Card)?;
        }
        Ok(())
    }

    /// Writes the page of this template with these values and the runs that are `missing`, says where it is, and ends: with an error if
    /// a run failed, which the page is then without.
    pub(crate) fn finish(self, template: &str, values: Value) -> anyhow::Result<()> {
        self.progress.clear();
        let time = time(self.seconds, self.at_once, self.kept_piece(CORES));
        let values = context! { missing => self.missing, ..values };
        let text = page(template, values, self.smoke, &time);
        let path = self.folder.join("README.md");
        write_whole(&path, text.as_bytes())?;
        print(&format!("{}{}\n", summary(&text), path.display()))?;
        self.check_made()
    }
}

/// The settings that the experiment's pieces were made with; none if there are none yet, or they cannot be read.
pub(crate) fn settings_of<T: DeserializeOwned>(name: &str, flags: &ExperimentFlags) -> Option<T> {
    let text = fs::read_to_string(folder(name, flags).join(PIECES).join(SETTINGS)).ok()?;
    serde_json::from_str(&text).ok()
}

/// The folder of the experiment `name`, by what the flags say.
fn folder(name: &str, flags: &ExperimentFlags) -> PathBuf {
    let default = || Path::new("experiments").join(name);
    flags.out.clone().unwrap_or_else(default)
}

/// Names this program and the processor it runs on, for [`Session::piece_of`]: the size of its file and when that was written.
pub(crate) fn program() -> anyhow::Result<String> {
    let file = process_env::program();
    let about = fs::metadata(&file).with_context(|| format!("looking at {}", file.display()))?;
    let written = about.modified().ok();
    let written = written.and_then(|it| it.duration_since(SystemTime::UNIX_EPOCH).ok());
    Ok(format!(
        "{} bytes of {} s, {}",
        about.len(),
        written.map_or(0.0, |it| it.as_secs_f64()),
        resources::processor()
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use driml_machine::error::Usage;

    #[test]
    fn a_piece_is_made_once_and_other_settings_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let flags = ExperimentFlags {
            smoke: true,
            out: Some(folder.path().join("walk")),
            seeds: None,
        };
        let open = |settings: &str| Session::open("walk", &flags, &settings, 40, false);
        let report = |settings: &str| Session::open("walk", &flags, &settings, 40, true);
        assert!(report("a").unwrap_err().is::<Usage>());
        assert!(!folder.path().join("walk").exists());
        // Of runs that were copied there, with the wrong flags: they are not what is kept.
        fs::create_dir_all(folder.path().join("walk/runs")).unwrap();
        let copied = report("wrong").unwrap();
        assert_eq!(copied.kept_piece::<u32>(CORES), None, "of another machine");
        let mut session = open("a").unwrap();
        assert_eq!(session.piece_of("", "one", 2, |_| Ok(7)).unwrap(), 7);
        let failed = session.piece_of::<u32>("", "two", 2, |_| bail!("stopped"));
        assert!(failed.is_err());

        let made = |key: &str, made: u32| open("a").unwrap().piece_of("", key, 2, |_| Ok(made));
        assert_eq!(made("one", 8).unwrap(), 7, "it is kept");
        assert_eq!(made("two", 8).unwrap(), 8);
        // Cut off in the middle of a write by a crash of the machine.
        fs::write(folder.path().join("walk/pieces/one.json"), "{\"seconds\":").unwrap();
        assert_eq!(made("one", 9).unwrap(), 9);
        assert!(open("b").unwrap_err().is::<Usage>());
        // What it was made of has changed.
        let mut of = |of: &str, made: u32| session.piece_of(of, "played", 1, |_| Ok(made)).unwrap();
        let all = [of("x", 1), of("x", 2), of("y", 3), of("y", 4)];
        assert_eq!(all, [1, 1, 3, 3]);
        // Read whatever it was made of.
        assert_eq!(session.kept_piece::<u32>("played"), Some(3));
        assert_eq!(session.kept_piece::<u32>("never"), None);
        session.keep("calls", ["driml tradeoff"]).unwrap();
        let calls: Option<Vec<String>> = session.kept_piece("calls");
        assert_eq!(calls.unwrap(), ["driml tradeoff"]);
        let mut reported = report("a").unwrap();
        let cores = reported.kept_piece(CORES);
        assert_eq!(cores, Some(Machine::this().cores));
        let made = session.piece_of("w, an old program", "errors", 1, |_| Ok(1));
        assert_eq!(made.unwrap(), 1);
        let computed = |session: &mut Session, what: &str, made: u32| {
            session.computed(what, "errors", 1, |_| Ok(made)).unwrap()
        };
        assert_eq!(computed(&mut reported, "w", 2), 1);
        assert_eq!(computed(&mut session, "w", 3), 3);
        assert_eq!(computed(&mut reported, "v", 4), 4);
        assert!(report("b").unwrap_err().is::<Usage>());
        // Ctrl-C while it is made: first it is kept.
        let stopped = session.piece_of("", "slow", 1, |progress| {
            nix::sys::signal::raise(nix::sys::signal::Signal::SIGINT)?;
            progress.shutdown().ending.wait();
            Ok(5)
        });
        assert!(stopped.unwrap_err().is::<Interrupted>());
        assert_eq!(session.kept_piece::<u32>("slow"), Some(5));
        // Runs that failed are no fault of the call.
        for (session, is_usage) in [(&mut session, false), (&mut reported, true)] {
            session.count_runs(0.0, 1, vec!["a".into()]);
            let said = session.check_any::<u32>(&[]).unwrap_err();
            assert_eq!(said.is::<Usage>(), is_usage);
            assert_eq!(said.to_string().ends_with(": a"), !is_usage);
            assert_eq!(session.check_made().is_ok(), is_usage);
        }
    }
}
