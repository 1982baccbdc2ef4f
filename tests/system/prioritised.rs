//! Rows drawn by priority, in a whole run with two replay servers. Servers that die are in `durable`, lockstep in `lockstep`.
//! The distribution of the draws is tested beside the code.

use driml_tests::Outcome;

use crate::{PRIORITISED, ROWS, SHORT, system};

/// Returns the numbers of the last line with `words`. A replay server logs rows whose priority was set, came too late and came twice; the
/// learner logs updates whose priorities arrived.
pub(crate) fn logged_counts<const N: usize>(log: &str, words: &str) -> [u64; N] {
    let line = log.lines().rfind(|line| line.contains(words));
    let line = line.unwrap_or_else(|| panic!("no word of priorities: {log}"));
    let start = line.find("priorities of ").unwrap();
    let numbers = line[start..].split(|c: char| !c.is_ascii_digit());
    let numbers: Vec<u64> = numbers.filter_map(|word| word.parse().ok()).collect();
    numbers.try_into().unwrap()
}

pub(crate) const ROWS_WERE_SET: &str = "rows were set";

/// The servers got the priorities of all updates that the learner counts as arrived. On a busy machine it exits before some arrive.
#[test]
fn the_learner_s_losses_come_back_to_the_replay_that_drew_the_rows() {
    let system = system();
    system.run_ok(&format!(
        "local --agent driml-ada {SHORT} {PRIORITISED} --actors 2 --replay-shards 2 --run-dir run"
    ));
    let run = system.run_folder("run");
    let summary = run.check(Outcome::Finished);
    let mut logs = system.file_names("run/logs");
    logs.retain(|name| name.starts_with("replay-server"));
    let all = logs.iter().map(|name| {
        let log = system.read(&format!("run/logs/{name}"));
        logged_counts::<3>(&log, ROWS_WERE_SET)
    });
    let sums = all.fold([0; 3], |sums, counts| {
        std::array::from_fn(|at| sums[at] + counts[at])
    });
    let [set, gone, repeated] = sums;
    let rows = summary.replay.rows_sampled;
    let [arrived] = logged_counts(&run.log("learner"), "updates have arrived");
    assert!(set + gone <= rows, "{sums:?} of {rows}");
    assert!(arrived * 4 > summary.updates, "{arrived}");
    let least = arrived * u64::from(ROWS);
    assert!(set + gone >= least, "{sums:?}, {arrived} updates");
    assert_eq!(repeated, 0);
    assert!(gone * 10 < rows, "{sums:?} of {rows}");
}
