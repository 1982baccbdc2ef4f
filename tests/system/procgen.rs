//! Real Procgen through all processes. The engine is fetched into the cache folder once, as `driml local` does.
//! With `DRIML_OFFLINE=1` each test here is skipped and says so; what each game does is tested beside the worlds.

use driml_tests::skipped_offline;

use crate::system;

#[test]
fn bigfish_trains_and_is_evaluated_on_unseen_levels() {
    if skipped_offline("procgen::bigfish_trains_and_is_evaluated_on_unseen_levels") {
        return;
    }
    let system = system();
    system
        .run("local --env procgen:bigfish --agent driml-ada --preset smoke --frames 608 --actors 2 --run-dir run")
        .expect_code(0);
    let summary = system.run_folder("run").check_finished();
    assert_eq!((summary.frames, summary.updates), (608, 25));
    assert!(summary.mean_k.is_some());
    let ended = system
        .run("evaluate --run run --episodes 2 --levels unseen")
        .expect_code(0);
    assert!(
        ended
            .stdout
            .starts_with("procgen:bigfish on unseen levels, 2 episodes each"),
        "{}",
        ended.stdout
    );
}

#[test]
fn an_experiment_of_whole_runs_normalises_and_plays_unseen_levels() {
    if skipped_offline("procgen::an_experiment_of_whole_runs_normalises_and_plays_unseen_levels") {
        return;
    }
    let system = system();
    system
        .run("experiment procgen --smoke --games bigfish --agents c51,driml-ada --seeds 1 --frames 608 --out table")
        .expect_code(0);
    let page = std::fs::read_to_string(system.path("table").join("README.md")).unwrap();
    for part in [
        "(paper 4.45 ± 0.71)",
        "| agent | interquartile mean, levels trained on | interquartile mean, unseen levels |",
        "\n| `driml-ada` | 0.",
    ] {
        assert!(page.contains(part), "{part}\n{page}");
    }
}
