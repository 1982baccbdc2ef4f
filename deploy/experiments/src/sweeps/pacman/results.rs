//! What the runs of Fig. 3 left: their losses over frames, and their returns over episodes.

use super::{
    plans::RunKind,
    settings::{Continual, Settings},
};
use crate::{plot::Run, runs::FinishedRun, statistics::Spread};

/// The DIM losses of the preset: column of the metrics, and what it compares.
pub(super) const LOSSES: [(&str, &str); 2] = [("dim_3t3", "local"), ("dim_4t4", "global")];

/// (x, y) in the order of x.
pub(super) type Points = Vec<(f64, f64)>;

/// All there is to report.
pub(super) struct Results {
    pub(super) settings: Settings,
    /// Part and seed of each finished run.
    pub(super) runs: Vec<(RunKind, u32, FinishedRun)>,
    /// Runs that are missing.
    pub(super) missing: Vec<String>,
    pub(super) command: String,
    pub(super) smoke: bool,
}

/// Training return over episodes.
pub(super) struct Trace {
    pub(super) agent: String,
    pub(super) seed: u32,
    pub(super) points: Points,
}

impl Trace {
    /// The mean return at the end of a task, counted from 0, and its mean over the task; none if the run has no row there.
    pub(super) fn task(&self, continual: &Continual, task: u64) -> Option<(f64, f64)> {
        let length = continual.episodes_per_task as f64;
        let (start, end) = (length * task as f64, length * (task + 1) as f64);
        let inside = self.points.iter().filter(|(x, _)| *x > start && *x <= end);
        let values: Vec<f64> = inside.map(|point| point.1).collect();
        Some((*values.last()?, Spread::of(values.iter().copied())?.mean))
    }
}

/// Values of a loss in all runs with this epsilon.
pub(super) fn loss_of(
    results: &Results,
    epsilon: f64,
    column: &str,
) -> anyhow::Result<Vec<(u32, Points)>> {
    let runs = results
        .runs
        .iter()
        .filter(|(kind, ..)| *kind == RunKind::Epsilon(epsilon));
    runs.map(|(_, seed, ran)| Ok((*seed, Run::read(&ran.folder)?.values(column)?)))
        .collect()
}

/// Mean return of the last 100 episodes over episodes, up to the end of the last task.
pub(super) fn traces(results: &Results, noise: bool) -> anyhow::Result<Vec<Trace>> {
    let settings = &results.settings;
    let continual = if noise {
        &settings.noise
    } else {
        &settings.continual
    };
    let mut traces = Vec::new();
    for (kind, seed, ran) in &results.runs {
        let agent = match kind {
            RunKind::Ghosts(agent) if !noise => agent,
            RunKind::Noise(agent) if noise => agent,
            _ => continue,
        };
        let run = Run::read(&ran.folder)?;
        let (returns, episodes) = (run.values("mean_return")?, run.values("episodes")?);
        // Once known, the return is in every row: the last rows of both belong together.
        let rows = returns.iter().rev().zip(episodes.iter().rev());
        let mut points: Vec<_> = rows.map(|(mean, episodes)| (episodes.1, mean.1)).collect();
        points.reverse();
        points.dedup_by_key(|point| point.0);
        points.retain(|point| point.0 <= continual.episodes() as f64);
        traces.push(Trace {
            agent: agent.clone(),
            seed: *seed,
            points,
        });
    }
    Ok(traces)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_s_end_is_its_last_row() {
        let continual = Continual {
            tasks: 2,
            order: vec![0, 2],
            episodes_per_task: 10,
            envs: 2,
            sets: Vec::new(),
        };
        let trace = Trace {
            agent: "c51".into(),
            seed: 1,
            points: vec![(4.0, 1.0), (10.0, 3.0), (11.0, 0.0), (18.0, 5.0)],
        };
        assert_eq!(trace.task(&continual, 0), Some((3.0, 2.0)));
        assert_eq!(trace.task(&continual, 1), Some((5.0, 2.5)));
        assert_eq!(trace.task(&continual, 2), None);
    }
}
