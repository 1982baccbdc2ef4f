//! Real Procgen through all processes. The engine is downloaded into the cache folder once, as `driml local` does.
//! With `DRIML_OFFLINE=1` each of these tests is skipped by name. Each game is tested with the code of the worlds.

use driml_tests::{TestSystem, check_has, skipped_offline};

use crate::system;

/// Creates a system if the engine may be downloaded. Otherwise returns `None` and reports the test as skipped.
fn with_engine() -> Option<TestSystem> {
    (!skipped_offline()).then(system)
}

#[test]
fn bigfish_trains_and_is_evaluated_on_unseen_levels() {
    let Some(system) = with_engine() else { return };
    let flags = "--env procgen:bigfish --agent driml-ada --preset smoke --frames 608 --actors 2";
    let summary = system.train(flags, "run");
    assert_eq!((summary.frames, summary.updates), (608, 25));
    assert!(summary.mean_k.is_some());
    system
        .run_ok("evaluate run --episodes 2 --levels unseen")
        .expect_stdout("procgen:bigfish on unseen levels, 2 episodes each");
}

#[test]
fn an_agent_chooses_among_the_actions_that_differ() {
    let Some(system) = with_engine() else { return };
    let flags = "--lockstep --env procgen:plunder --agent driml-ada --preset smoke --frames 416 \
                 --set actor.actions=visible --set learner.affinity.alphabet=visible";
    system.train(flags, "run");
    let config = system.run_folder("run").config();
    assert_eq!(config["model"]["num_actions"].as_integer(), Some(4));
    system.run_ok("evaluate run --episodes 2 --levels unseen");
}

#[test]
fn an_experiment_of_three_seeds_has_scores_over_games() {
    let Some(system) = with_engine() else { return };
    system
        .run_ok("experiment procgen --smoke --games bigfish --agents c51,driml-ada --seeds 3 --frames 608 --episodes 1 --out table");
    let page = system.read("table/README.md");
    let lines = [
        "| game | random | c51 training | c51 greedy | c51 paper |",
        "| 4.45 |\n",
        "* Interquartile mean of `driml-ada` over 1 game: 0.",
        "* Probability that `driml-ada` trains better than `c51`: ",
    ];
    check_has(&page, &lines);
    let table = system.read("table/table.csv");
    check_has(&table, &["\nbigfish,driml-ada,nature,3,608,"]);
}
