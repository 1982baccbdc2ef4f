//! What an adaptive k did in a run: k over time, and which kinds of actions the agent took.
//! It reads the run's metrics and summary alone.

use driml_envs::{WorldName, visible_actions};
use driml_launch::run_folder::Summary;

use crate::plot::Run;

/// Points of k over a run.
const WINDOWS: usize = 40;
/// Least updates of a window: batches on their way blur shorter ones.
const WINDOW_UPDATES_MIN: f64 = 10.0;

/// (frames, mean k of the rows served in the window that ends there).
///
/// The metrics have the mean since the start, K(u) after u updates; a window's own is
/// `(K(v) v - K(u) u) / (v - u)`, as every update is served the same number of rows.
pub(super) fn windowed(run: &Run) -> anyhow::Result<Vec<(f64, f64)>> {
    let (ks, updates) = (run.values("mean_k")?, run.values("updates")?);
    // Once known, k is in every row: the last rows of both belong together.
    let rows = ks.iter().rev().zip(updates.iter().rev());
    let mut rows: Vec<_> = rows.map(|(k, updates)| (k.0, k.1, updates.1)).collect();
    rows.reverse();
    let last = rows.last().map_or(0.0, |row| row.2);
    let step = (last / WINDOWS as f64).max(WINDOW_UPDATES_MIN);
    let (mut points, mut from) = (Vec::new(), (0.0, 0.0));
    for (frames, k, updates) in rows {
        if updates - from.1 >= step {
            points.push((frames, (k * updates - from.0 * from.1) / (updates - from.1)));
            from = (k, updates);
        }
    }
    Ok(points)
}

/// Shares of the actions taken: movement, no-op, special. As the paper, by what an action amounts to in its game.
pub(super) fn kinds(world: WorldName, summary: &Summary) -> [f64; 3] {
    let mut counts = [0; 3];
    for (action, count) in summary.action_histogram.iter().enumerate() {
        counts[kind(world, action)] += count;
    }
    let all = counts.iter().sum::<u64>().max(1) as f64;
    counts.map(|count| count as f64 / all)
}

/// 0 a movement, 1 no-op, 2 special.
fn kind(world: WorldName, action: usize) -> usize {
    let game = world.settings().find(|(key, _)| *key == "game");
    match game.and_then(|(_, game)| game.parse().ok()) {
        Some(game) => match visible_actions(game).get(action) {
            Some(4) => 1,
            Some(0..9) => 0,
            _ => 2,
        },
        // Every other world's first action is its no-op.
        None => usize::from(action == 0),
    }
}

#[cfg(test)]
mod tests {
    use driml_launch::run_folder::RunFolder;

    use super::*;

    #[test]
    fn windows_undo_the_mean_since_the_start() {
        let folder = tempfile::tempdir().unwrap();
        // k is 1 for 100 updates, then 3 for 100: the mean since the start ends at 2.
        let mut text = "seconds,frames,updates,mean_k\n0,0,0,\n".to_owned();
        for updates in (20..=200).step_by(20) {
            let sum = updates + 2 * (updates - 100i32).max(0);
            let mean = f64::from(sum) / f64::from(updates);
            text += &format!("1,{},{updates},{mean}\n", updates * 32);
        }
        std::fs::write(folder.path().join("metrics.csv"), text).unwrap();
        let points = windowed(&Run::read(&RunFolder::new(folder.path())).unwrap()).unwrap();
        assert_eq!(points.len(), 10);
        for (frames, k) in points {
            let expected = if frames <= 3_200.0 { 1.0 } else { 3.0 };
            assert!((k - expected).abs() < 1e-9, "{k} at {frames}");
        }
    }

    #[test]
    fn actions_are_of_three_kinds() {
        let world: WorldName = "procgen:bigfish".parse().unwrap();
        assert_eq!(
            [0, 4, 8, 9, 14].map(|action| kind(world, action)),
            [0, 1, 0, 1, 1]
        );
        let world: WorldName = "procgen:starpilot".parse().unwrap();
        assert_eq!(
            [3, 4, 9, 14].map(|action| kind(world, action)),
            [0, 1, 2, 2]
        );
        assert_eq!(kind("mspacman".parse().unwrap(), 0), 1);
    }
}
