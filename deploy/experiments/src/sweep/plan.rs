//! The planned and the finished runs of a sweep, each at its point on the axes, and the calls that make them.
//! This module reads no folder and starts no run.

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

use crate::cache::file_name;

/// The flags of `driml train` that make a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct TrainCall {
    pub(crate) env: Option<String>,
    pub(crate) agent: Option<String>,
    pub(crate) preset: Option<String>,
    pub(crate) seed: u32,
    pub(crate) frames: Option<u64>,
    /// Settings in the form of `--set`.
    pub(crate) sets: Vec<String>,
}

impl TrainCall {
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

    /// Resolves the settings for this machine, whatever memory is free now.
    pub(crate) fn config(&self) -> Result<RunConfig, Usage> {
        self.config_within(u64::MAX)
    }

    fn config_within(&self, memory_bytes: u64) -> Result<RunConfig, Usage> {
        let flags = RunFlags {
            env: self.env.clone(),
            agent: self.agent.clone(),
            preset: self.preset.clone(),
            config: None,
            flags: Flags {
                frames: self.frames,
                seed: Some(self.seed.into()),
                sets: self.sets.clone(),
                ..Flags::default()
            },
        };
        let machine = Machine {
            memory_bytes,
            ..Machine::detect()
        };
        Ok(resolve(&flags, &machine)?.0)
    }
}

/// A run to be made. Plans are ordered by seed, so that a stopped sweep has one seed of every point before two of any.
#[derive(Clone, Debug)]
pub(crate) struct PlannedRun {
    pub(crate) name: String,
    pub(crate) call: TrainCall,
    pub(crate) frames: u64,
    /// The number of episodes after which the run may stop before it has all its frames.
    pub(crate) episodes: Option<u64>,
    /// The units of work that the run counts for in the progress.
    pub(crate) units: u64,
}

impl PlannedRun {
    pub(crate) fn new(name: &str, call: TrainCall, frames: u64) -> Self {
        Self {
            name: file_name(name),
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
    /// The commit that the program was built from; empty if it was not recorded. If programs of several commits made and resumed the run,
    /// the commits are joined by `+`.
    pub(crate) commit: String,
}

/// A planned run, with its point on the axes of the sweep.
pub(crate) type PointPlan<P> = (P, PlannedRun);

pub(crate) struct PointRun<P> {
    pub(crate) point: P,
    pub(crate) plan: PlannedRun,
    pub(crate) run: FinishedRun,
}

/// Resolves the settings of each point's first run, and installs what its world needs: the other seeds need the same. For a report it does
/// nothing. Call it before anything is written, so that the user can correct the call and use the same folder.
pub(crate) fn install_worlds<P>(plans: &[PointPlan<P>], report: bool) -> anyhow::Result<()> {
    let first = plans.iter().filter(|(_, plan)| plan.call.seed == 1);
    for (_, plan) in first.filter(|_| !report) {
        let config = plan.call.config_within(Machine::detect().memory_bytes);
        let config = config.map_err(|e| usage!("the run {}: {e}", plan.name))?;
        // Whatever its value: all seeds of the point would have it.
        let sets_seed = |set: &String| set.trim_start().starts_with("run.seed");
        let is_as_planned = !plan.call.sets.iter().any(sets_seed) && config.frames() == plan.frames;
        ensure!(
            is_as_planned,
            usage!("--set changes the run's seed or frames: use --seeds and --frames")
        );
        config.world.install(&mut console::eprintln)?;
    }
    Ok(())
}
