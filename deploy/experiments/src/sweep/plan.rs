//! What a sweep plans and gets: runs at the points of its axes, and the calls that make them.
//! It knows no folder and starts no run.

use anyhow::ensure;
use driml_launch::{
    console,
    run_folder::{RunFolder, Summary},
};
use driml_machine::{
    error::{Usage, usage},
    resources::Machine,
};
use driml_settings::{
    config::RunConfig,
    flags::{Flags, RunFlags, resolve},
};

/// The flags of `driml train` that make a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Call {
    pub(crate) env: Option<String>,
    pub(crate) agent: Option<String>,
    pub(crate) preset: Option<String>,
    pub(crate) seed: u32,
    pub(crate) frames: Option<u64>,
    /// In the form of `--set`.
    pub(crate) sets: Vec<String>,
}

impl Call {
    pub(crate) fn args(&self) -> Vec<String> {
        let named = [
            ("--env", self.env.clone()),
            ("--agent", self.agent.clone()),
            ("--preset", self.preset.clone()),
            ("--seed", Some(self.seed.to_string())),
            ("--frames", self.frames.map(|it| it.to_string())),
        ];
        let sets = self.sets.iter().map(|set| ("--set", Some(set.clone())));
        let all = named.into_iter().chain(sets);
        let given = all.filter_map(|(flag, value)| Some([flag.to_owned(), value?]));
        given.flatten().collect()
    }

    pub(crate) fn config(&self) -> Result<RunConfig, Usage> {
        let flags = RunFlags {
            env: self.env.clone(),
            agent: self.agent.clone(),
            preset: self.preset.clone(),
            config: None,
            over: Flags {
                frames: self.frames,
                seed: Some(self.seed.into()),
                sets: self.sets.clone(),
                ..Flags::default()
            },
        };
        Ok(resolve(&flags, &Machine::this())?.0)
    }
}

/// A run to be made. Plans go seed by seed, so that what was stopped has one seed of everything before it has two of anything.
#[derive(Clone, Debug)]
pub(crate) struct PlannedRun {
    /// Its folder's name.
    pub(crate) name: String,
    pub(crate) call: Call,
    pub(crate) frames: u64,
    /// Episodes after which it is long enough, if that comes first.
    pub(crate) episodes: Option<u64>,
    /// Its share of the sweep's work.
    pub(crate) units: u64,
}

impl PlannedRun {
    /// One whose folder's name has a dash for each letter that does not belong there, such as those of a world's command.
    pub(crate) fn new(name: &str, call: Call, frames: u64) -> Self {
        let fits = |letter: char| letter.is_ascii_alphanumeric() || "-_=.+".contains(letter);
        let letters = name.chars().map(|it| if fits(it) { it } else { '-' });
        Self {
            name: letters.collect(),
            call,
            frames,
            episodes: None,
            units: frames,
        }
    }
}

#[derive(Clone, Debug)]
pub(crate) struct FinishedRun {
    pub(crate) folder: RunFolder,
    pub(crate) summary: Summary,
    /// The commit that the program which made it was built from; those of several, where others resumed it, parted by `+`; empty
    /// where it was not noted.
    pub(crate) commit: String,
}

/// A run that is planned, and what it is for: its place on the axes of its sweep.
pub(crate) type Planned<P> = (P, PlannedRun);

/// A finished run at its place in the sweep.
pub(crate) struct Made<P> {
    pub(crate) point: P,
    pub(crate) plan: PlannedRun,
    pub(crate) run: FinishedRun,
}

/// Resolves the settings of each call once, whatever its seed, and installs what its world needs; for a report it does nothing. To be
/// called before anything is written, so that a corrected call can have the same folder.
pub(crate) fn install<P>(plans: &[Planned<P>], report: bool) -> anyhow::Result<()> {
    let mut known: Vec<Call> = Vec::new();
    let plans = if report { &[] } else { plans };
    for (_, plan) in plans {
        let call = Call {
            seed: 1,
            ..plan.call.clone()
        };
        if !known.contains(&call) {
            let config = call.config();
            let config = config.map_err(|e| usage!("the run {}: {e}", plan.name))?;
            let is_its_own = config.run.seed == 1 && config.frames() == plan.frames;
            ensure!(
                is_its_own,
                usage!("--set changes the run's seed or frames: use --seeds and --frames")
            );
            config.world.install(&mut console::line)?;
            known.push(call);
        }
    }
    Ok(())
}
