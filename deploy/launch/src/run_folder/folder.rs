//! The paths of a run's files. No other module knows the names of these files. The learner is given a folder and puts its
//! checkpoints into `checkpoints/`.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
};

use driml_learner::checkpoint::{self, CheckpointError};
use driml_machine::{
    error::{Usage, usage},
    shell::quoted_path,
};
use driml_protocol::lock_file;
use driml_settings::config::RunConfig;

use super::table::{Table, aside_path, write_atomically};
use crate::output::check_folder;

pub(super) const EVENTS_PREFIX: &str = "events.out.tfevents.";

/// Makes a method for each file and folder of a run, which returns its path.
macro_rules! paths {
    ($($(#[$doc:meta])+ $vis:vis $method:ident: $name:expr;)+) => {
        impl RunFolder {
            $($(#[$doc])+ $vis fn $method(&self) -> PathBuf {
                self.path.join($name)
            })+
        }
    };
}

paths! {
    /// The resolved settings, TOML.
    pub config: "config.toml";
    /// One row per second: frames, updates, losses, speed, memory.
    pub metrics: "metrics.csv";
    /// One row per training episode: when it ended, who played it, its return and length.
    pub episodes: "episodes.csv";
    /// How the run ended and its counts, JSON; exists once the run has ended.
    pub summary: "summary.json";
    /// What a resumed run had done before its replay began to count, JSON.
    pub(super) resumed: "resumed.json";
    /// The endpoints of the replay servers, one per line, while `driml train` runs here.
    pub endpoints: "endpoints";
    /// The path of the folder in which the processes of `driml train` meet, while it runs here.
    pub(crate) rendezvous: "rendezvous";
    /// The returns of the checkpoints that were evaluated.
    pub evaluations: "evaluations.csv";
    /// A folder with the checkpoint that earned most.
    pub best: "best";
    /// A folder with one folder per checkpoint.
    pub checkpoints: driml_learner::checkpoint::FOLDER;
    /// A folder with the replay, if it is kept on disk.
    pub replay: "replay";
    /// A folder with one log file per process.
    pub logs: "logs";
    /// The file whose lock keeps other launchers out.
    lock_file: ".lock";
}

/// The folder of a run, which may not exist yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunFolder {
    path: PathBuf,
}

impl RunFolder {
    /// The folder at `path`; nothing is read from the disk.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into() }
    }

    /// The path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The path of the folder, for a message.
    pub fn display(&self) -> std::path::Display<'_> {
        self.path.display()
    }

    /// The path of the folder, for a command that a person may paste.
    pub fn quoted(&self) -> String {
        quoted_path(&self.path)
    }

    /// Rejects a folder that is not empty, and one that cannot be made. A run that ended before its first frame does not count: the
    /// corrected command may use its folder again.
    pub fn check_free(&self) -> Result<(), Usage> {
        let taken = match fs::read_dir(&self.path) {
            Ok(entries) => !self.is_empty_run(entries),
            Err(_) => self.path.is_dir(),
        };
        if taken {
            let next = match self.newest_checkpoint() {
                Some(_) => "resume its run with --resume",
                None => "remove it",
            };
            return Err(usage!(
                "the run folder {} exists and is not empty: choose another --run-dir, or {next}",
                self.display()
            ));
        }
        let checkpoints = self.checkpoints();
        if checkpoints.is_dir()
            && let Err(e @ CheckpointError::InUse(_)) = checkpoint::lock(&checkpoints)
        {
            return Err(Usage(e.to_string()));
        }
        check_folder("--run-dir", &self.path)
    }

    /// Whether the folder is empty, or holds only what a run makes before its first frame.
    fn is_empty_run(&self, entries: fs::ReadDir) -> bool {
        let tables = [self.metrics(), self.episodes()];
        let others = [
            self.config(),
            self.summary(),
            self.endpoints(),
            self.rendezvous(),
            self.checkpoints(),
            self.logs(),
            self.lock_file(),
        ];
        let has_frames = |path: &PathBuf| {
            let frames = Table::read(path).ok().and_then(|it| it.last("frames"));
            frames.is_some_and(|frames: u64| frames > 0)
        };
        let is_run_file = |it: &fs::DirEntry| {
            tables.iter().chain(&others).any(|made| *made == it.path())
                || it.file_name().to_string_lossy().starts_with(EVENTS_PREFIX)
        };
        let saved = checkpoint::list(&self.checkpoints());
        let entries: Vec<_> = entries.flatten().collect();
        entries.iter().all(|it| it.path() == self.lock_file())
            || entries.iter().all(is_run_file)
                && self.config().exists()
                && !tables.iter().any(has_frames)
                && saved.is_ok_and(|all| all.is_empty())
    }

    /// Keeps other launchers out as long as the returned file is held. Fails if another launcher holds it.
    pub fn lock(&self) -> anyhow::Result<File> {
        let path = self.lock_file();
        let folder = self.display();
        let lock = lock_file::acquire(&path, "start no other run there");
        let lock = lock.map_err(|e| {
            usage!("the run folder {folder} cannot be written: {e}; make it writable, or choose another")
        })?;
        lock.ok_or_else(|| {
            usage!("the run in {folder} is still running: stop it first, or wait").into()
        })
    }

    /// Whether another launcher holds the lock; also works for a user who may only read the folder.
    pub(crate) fn is_locked(&self) -> bool {
        let file = File::open(self.lock_file());
        file.is_ok_and(|file| matches!(lock_file::try_lock(&file), Ok(false)))
    }

    /// The updates and the path of the newest checkpoint; none if there is none, or if the checkpoints cannot be listed.
    pub fn newest_checkpoint(&self) -> Option<(u64, PathBuf)> {
        checkpoint::list(&self.checkpoints()).ok()?.pop()
    }

    pub(crate) fn check_intact(&self) -> anyhow::Result<()> {
        let files = [self.config(), self.metrics(), self.episodes()];
        // An error of a network file system may be temporary.
        let is_missing = |it: &&PathBuf| matches!(it.try_exists(), Ok(false));
        let missing = files.iter().filter(is_missing);
        let missing: Vec<_> = missing.map(|it| it.display().to_string()).collect();
        anyhow::ensure!(
            missing.is_empty(),
            "the run folder was removed or moved during the run: resume it at its new place, or start the run again; missing: {}",
            missing.join(", ")
        );
        Ok(())
    }

    pub(super) fn write_config(&self, config: &RunConfig) -> anyhow::Result<()> {
        let head = "# The resolved settings of this run; `driml train --config` with this file repeats it.\n";
        let program = match &*config.program {
            "" => String::new(),
            program => format!("# Written by {program}.\n"),
        };
        let text = format!("{head}{program}\n{}", config.to_toml());
        let path = self.config();
        // A resume may change settings and program: the earlier ones made what the run has.
        if self.newest_checkpoint().is_some()
            && let Ok(before) = fs::read(&path)
            && before != text.as_bytes()
        {
            write_atomically(&aside_path(&path), &before)?;
        }
        write_atomically(&path, text.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::testing;

    #[test]
    fn a_folder_that_cannot_be_had_says_why_and_a_free_one_is_taken() {
        let root = tempfile::tempdir().unwrap();
        let path = |name: &str| root.path().join(name);
        let refused = |name| RunFolder::new(path(name)).check_free().unwrap_err().0;
        fs::create_dir(path("empty")).unwrap();
        fs::write(path("file"), "").unwrap();
        let said = refused("file");
        assert!(said.contains("Not a directory"), "{said}");
        fs::create_dir(path("closed")).unwrap();
        fs::set_permissions(path("closed"), fs::Permissions::from_mode(0o555)).unwrap();
        // Root may write everywhere.
        if !nix::unistd::geteuid().is_root() {
            let said = refused("closed/one");
            assert!(said.contains("cannot be written: Permission"), "{said}");
        }
        for name in ["empty", "a/b/c"] {
            assert!(RunFolder::new(path(name)).check_free().is_ok(), "{name}");
        }
        // A lock that cannot be made is a wrong call, too.
        fs::create_dir(path("empty/.lock")).unwrap();
        let said = RunFolder::new(path("empty")).lock().unwrap_err();
        let said = said.downcast::<Usage>().unwrap().0;
        assert!(said.contains("cannot be written: Is a directory"), "{said}");
    }

    #[test]
    fn settings_that_a_resume_changes_stay_beside_the_new_ones() {
        let (root, folder) = testing::run_folder();
        let write = |set| {
            let config = testing::config("smoke", "chain", "c51", &[set]);
            folder.write_config(&config).unwrap();
        };
        let aside = |number| {
            let path = root.path().join(format!("config.aside-{number}.toml"));
            fs::read_to_string(path).unwrap_or_default()
        };
        write("learner.batch_size=16");
        write("learner.batch_size=17");
        assert_eq!(aside(1), "", "nothing was learned");
        fs::create_dir_all(folder.checkpoints().join("checkpoint-1")).unwrap();
        write("learner.batch_size=18");
        write("learner.batch_size=18");
        write("learner.batch_size=19");
        for (number, batch_size) in [(1, "= 17\n"), (2, "= 18\n")] {
            assert!(aside(number).contains(&format!("batch_size {batch_size}")));
        }
        assert_eq!(aside(3), "");
    }

    #[test]
    fn a_run_in_which_nothing_was_learned_gives_its_folder_back() {
        let (root, folder) = testing::run_folder();
        let write = |path: PathBuf, text: &str| fs::write(path, text).unwrap();
        // As on a full disk, where settings cannot be written.
        write(folder.lock_file(), "");
        assert!(folder.check_free().is_ok());
        write(folder.config(), "[run]\n");
        write(folder.metrics(), "seconds,frames\n0.5,0\n");
        write(folder.episodes(), "seconds,frames\n");
        write(folder.summary(), "{}");
        fs::create_dir_all(folder.logs()).unwrap();
        fs::create_dir_all(folder.checkpoints()).unwrap();
        assert!(folder.check_free().is_ok());
        let saving = checkpoint::lock(&folder.checkpoints()).unwrap();
        let said = folder.check_free().unwrap_err().to_string();
        assert!(said.contains("another learner saves in "), "{said}");
        drop(saving);

        write(folder.metrics(), "seconds,frames\n0.5,32\n");
        assert!(folder.check_free().is_err(), "it has frames");
        write(folder.metrics(), "seconds,frames\n");
        fs::create_dir(folder.checkpoints().join("checkpoint-0")).unwrap();
        let said = folder.check_free().unwrap_err().to_string();
        assert!(said.ends_with("resume its run with --resume"), "{said}");
        fs::remove_dir(folder.checkpoints().join("checkpoint-0")).unwrap();
        write(root.path().join("thesis.tex"), "");
        assert!(folder.check_free().is_err(), "it has files of others");
    }
}
