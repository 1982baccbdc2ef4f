//! The results of the runs of Fig. 3: losses over frames, and returns over episodes.

use driml_launch::run_folder::{RunFolder, Table};
use driml_protocol::RETURNS_MAX;
use serde::Serialize;

use super::settings::{Continual, PARTS, Point, Settings};
use crate::{
    plot::{Run, smooth},
    stats::{mean, rank_correlation},
    sweep::PointRun,
};

/// The DIM losses of the preset: the column of the metrics, and the kind of features that the loss compares.
pub(super) const LOSSES: [(&str, &str); 2] = [("dim_3t3", "local"), ("dim_4t4", "global")];
/// The final loss is the mean over this share of a run, at its end.
const FINAL_SHARE: f64 = 0.2;

/// Points (x, y), sorted by x.
pub(super) type Points = Vec<(f64, f64)>;

pub(super) struct Results {
    pub(super) settings: Settings,
    pub(super) losses: Vec<Loss>,
    pub(super) traces: [Vec<Trace>; PARTS],
}

/// A loss over frames in a run of part (a).
#[derive(Serialize)]
pub(super) struct Loss {
    pub(super) epsilon: f64,
    pub(super) seed: u32,
    pub(super) column: &'static str,
    #[serde(skip)]
    pub(super) points: Points,
    /// The means of the last fifth and of the whole run; `None` without values.
    pub(super) last: Option<f64>,
    pub(super) whole: Option<f64>,
    pub(super) episodes: f64,
}

/// Training return, the mean of the last [`RETURNS_MAX`] episodes, over episodes up to the end of the last task.
#[derive(Serialize)]
pub(super) struct Trace {
    pub(super) agent: String,
    pub(super) seed: u32,
    #[serde(skip)]
    pub(super) points: Points,
    /// For each task the return at its end, and the mean over the task; `None` if no episode of the task has a return.
    pub(super) tasks: Vec<Option<(f64, f64)>>,
}

impl Results {
    pub(super) fn read(settings: Settings, made: Vec<PointRun<Point>>) -> anyhow::Result<Self> {
        let (mut losses, mut traces) = (Vec::new(), [const { Vec::new() }; PARTS]);
        for PointRun { point, plan, run } in made {
            let seed = plan.call.seed;
            match point {
                Point::Epsilon(epsilon) => {
                    let metrics = Run::read(&run.folder)?;
                    let frames = settings.predictability.frames as f64;
                    for (column, _) in LOSSES {
                        let points = metrics.values("frames", column)?;
                        losses.push(Loss {
                            epsilon,
                            seed,
                            column,
                            last: mean_from(&points, frames * (1.0 - FINAL_SHARE)),
                            whole: mean_from(&points, 0.0),
                            episodes: run.summary.episodes as f64,
                            points,
                        });
                    }
                }
                Point::Tasks(part, agent) => {
                    let continual = settings.continual(part);
                    // A short run is over after few rows of metrics, so count its episodes.
                    let mut points = smooth(&training_returns(&run.folder)?, RETURNS_MAX as f64);
                    points.retain(|point| point.0 <= continual.episodes() as f64);
                    traces[part].push(Trace {
                        agent,
                        seed,
                        tasks: task_returns(&points, continual),
                        points,
                    });
                }
            }
        }
        Ok(Self {
            settings,
            losses,
            traces,
        })
    }

    pub(super) fn losses(&self, column: &str, epsilon: f64) -> impl Iterator<Item = &Loss> {
        let all = self.losses.iter();
        all.filter(move |it| it.column == column && it.epsilon == epsilon)
    }

    pub(super) fn traces(&self, part: usize, agent: &str) -> impl Iterator<Item = &Trace> {
        self.traces[part].iter().filter(move |it| it.agent == agent)
    }

    /// Returns the rank correlation of epsilon and a final loss, and the number of runs in it.
    pub(super) fn epsilon_correlation(&self, column: &str) -> Option<(f64, usize)> {
        let pairs = self.losses.iter().filter(|it| it.column == column);
        let pairs = pairs.filter_map(|it| Some((it.epsilon, it.last?)));
        let pairs: Points = pairs.collect();
        Some((rank_correlation(&pairs)?, pairs.len()))
    }
}

/// Returns the number and the return of each training episode.
fn training_returns(folder: &RunFolder) -> anyhow::Result<Points> {
    let episodes = Table::read(&folder.episodes())?;
    let value = |row, name| episodes.value(row, name);
    let point = |row| value(row, "episode").zip(value(row, "return"));
    Ok(episodes.rows.iter().filter_map(point).collect())
}

fn mean_from(points: &Points, frames: f64) -> Option<f64> {
    let late = points.iter().filter(|point| point.0 >= frames);
    mean(&late.map(|point| point.1).collect::<Vec<_>>())
}

fn task_returns(points: &Points, continual: &Continual) -> Vec<Option<(f64, f64)>> {
    let length = continual.episodes_per_task as f64;
    let of_task = |task: u64| {
        let (start, end) = (length * task as f64, length * (task + 1) as f64);
        let inside = points.iter().filter(|(x, _)| *x > start && *x <= end);
        let values: Vec<f64> = inside.map(|point| point.1).collect();
        Some((*values.last()?, mean(&values)?))
    };
    (0..continual.tasks).map(of_task).collect()
}

impl Trace {
    /// Returns the mean over all tasks; `None` if the run lacks a task.
    pub(super) fn mean_over_tasks(&self) -> Option<f64> {
        let tasks = self.tasks.iter().map(|task| Some((*task)?.1));
        mean(&tasks.collect::<Option<Vec<_>>>()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_s_end_is_its_last_row() {
        let continual = Continual {
            tasks: 3,
            order: vec![0, 2],
            episodes_per_task: 10,
            envs: 2,
            sets: Vec::new(),
        };
        let points = vec![(4.0, 1.0), (10.0, 3.0), (11.0, 0.0), (18.0, 5.0)];
        let expected = [Some((3.0, 2.0)), Some((5.0, 2.5)), None];
        assert_eq!(task_returns(&points, &continual), expected);
    }
}
