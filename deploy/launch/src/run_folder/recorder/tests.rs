//! The run folder's files: what a run leaves, and what a resumed run continues.

use std::fs;

use driml_actor::Schedule;
use driml_protocol::{LearnerStatus, Waiting};
use expect_test::expect;

use super::*;
use crate::{
    run_folder::{LastPlay, ReturnInterval},
    testing::{self, make, run_folder},
};

fn settings() -> RunConfig {
    testing::config("smoke", "chain", "driml-ada", &[])
}

fn open(
    folder: &RunFolder,
    processes: &[&str],
    resumed: Option<ResumePoint>,
) -> anyhow::Result<RunRecorder> {
    let processes = processes.iter().map(ToString::to_string).collect();
    RunRecorder::open(folder, &settings(), processes, resumed, false)
}

/// A point where a run is resumed, with 16 rows per update.
fn point(updates: u64) -> ResumePoint {
    make(|it: &mut ResumePoint| {
        (it.updates, it.rows, it.frames) = (updates, 31 * 16, 2_000);
        it.frames_max = 9_999;
    })
}

fn view(replay: ReplayStatus, learner: LearnerStatus) -> RunView {
    let epsilon = Schedule {
        start: 0.5,
        end: 0.1,
        decay_frames: 4_000,
    };
    let plan = Plan {
        epsilon: Some(epsilon),
        ..Plan::new(&settings())
    };
    testing::view(plan, replay, Some(learner))
}

/// The view of a run after this many frames, updates of 16 rows, and episodes.
fn after(frames: u64, updates: u64, episodes: u64, k_histogram: [u64; 3]) -> RunView {
    let replay = ReplayStatus {
        transitions_inserted: frames,
        warmup_transitions: 1_000,
        rows_sampled: updates * 16,
        episodes,
        k_histogram: k_histogram.to_vec(),
        waiting: Waiting::Finished,
        ..ReplayStatus::default()
    };
    let learner = LearnerStatus {
        updates,
        losses: vec![("dim_4t4".into(), 2.0)],
        weights_version: 4,
        weights_sha256: "abcd".into(),
        finished: true,
        ..LearnerStatus::default()
    };
    view(replay, learner)
}

#[test]
fn a_run_leaves_settings_metrics_and_a_summary() {
    let (_root, run) = run_folder();
    let mut recorder = open(&run, &["replay-server", "actor-0"], None).unwrap();
    let mut all = after(2_000, 31, 7, [2, 1, 1]);
    recorder.record(&mut after(0, 0, 0, [0; 3]), &[]);
    recorder.record(&mut all, &[Some(12.34), None]);
    let summary = recorder.summarise(Outcome::Finished, &mut all);
    summary.write(&run).unwrap();
    assert!(Summary::is_finished(&run));
    let counts = (summary.frames, summary.replay_ratio, summary.mean_k);
    assert_eq!(counts, (2_000, Some(0.496), Some(1.5)));

    let table = Table::read(&run.metrics()).unwrap();
    assert_eq!(table.header[..2], ["seconds", "frames"]);
    let memory = ["rss_mib_replay_server", "rss_mib_actor_0"].map(String::from);
    assert!(table.header.ends_with(&memory), "{:?}", table.header);
    let epsilons = table.rows.iter().map(|row| table.value(row, "epsilon"));
    assert_eq!(epsilons.collect::<Vec<_>>(), [Some(0.5), Some(0.3)]);

    let json = fs::read(run.summary()).unwrap();
    let json: serde_json::Value = serde_json::from_slice(&json).unwrap();
    let keys = "frames updates resumed_after_updates replay_ratio episodes mean_return_of wall_seconds frames_per_second \
                updates_per_second mean_k weights_version weights_sha256 replay_servers_restarted actors_restarted";
    let of_replay = "transitions_inserted transitions_refilled transitions_lost transitions_duplicated rows_sampled rows_unlearned \
                     k_histogram chunks_retried messages_refused";
    for (of, keys) in [(&json, keys), (&json["replay"], of_replay)] {
        for key in keys.split(' ') {
            assert!(!of[key].is_null(), "{key}");
        }
    }
    assert_eq!(json["outcome"], "finished");
    assert_eq!(json["rss_mib_max"]["replay-server"], 12.0);
}

#[test]
fn the_time_of_a_failed_start_is_not_that_of_the_next_run() {
    let (_root, run) = run_folder();
    let failed = open(&run, &[], None).unwrap();
    let summary = Summary {
        wall_seconds: 120.0,
        ..failed.summarise(Outcome::Failed, &mut RunView::default())
    };
    summary.write(&run).unwrap();
    drop(failed);
    assert!(open(&run, &[], None).unwrap().seconds() < 60.0);
}

#[test]
fn a_resumed_run_continues_in_its_metrics() {
    let (_root, run) = run_folder();
    let processes = ["replay-server"];
    let mut recorder = open(&run, &processes, None).unwrap();
    // Mean k is 1.5 before the run is resumed, and 2 since.
    let (k_before, k_since) = ([2, 1, 1], [0, 0, 5]);
    let mut view = RunView::default();
    for (frames, updates, episodes) in [(1_000, 0, 1), (2_000, 31, 7), (3_000, 62, 9)] {
        view = after(frames, updates, episodes, k_before);
        recorder.record(&mut view, &[]);
    }
    let said = open(&run, &processes, Some(point(31))).unwrap_err();
    assert!(said.to_string().contains("is still running"), "{said}");
    let summary = recorder.summarise(Outcome::Interrupted, &mut view);
    summary.write(&run).unwrap();
    drop(recorder);
    // As after a launcher was killed while it wrote a row.
    let path = run.metrics();
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, format!("{text}9.0,40")).unwrap();

    let summary = Summary {
        wall_seconds: 50.0,
        ..summary
    };
    summary.write(&run).unwrap();
    let mut recorder = open(&run, &processes, Some(point(31))).unwrap();
    assert!(!run.summary().exists());
    assert!(recorder.seconds() >= 50.0);
    // While the replay fills again, nothing is new.
    recorder.record(&mut after(2_000, 31, 1, k_before), &[]);
    let mut resumed = after(2_100, 62, 2, k_since);
    resumed.after_updates = Some(31);
    recorder.record(&mut resumed, &[]);
    let summary = recorder.summarise(Outcome::Finished, &mut resumed);
    let counts = (summary.frames, summary.updates, summary.episodes);
    assert_eq!(counts, (2_100, 62, 7 + 2));
    assert_eq!(summary.mean_k, Some(1.75), "31 updates at 1.5, 31 at 2");
    assert_eq!(summary.resumed_after_updates, 31);
    drop(recorder);
    // The run's replay, which is kept from now on, counts what came after the first resume.
    let kept = |updates, frames_max| ResumePoint {
        replay_is_kept: true,
        frames_max,
        ..point(updates)
    };
    let recorder = open(&run, &processes, Some(kept(62, 9_999))).unwrap();
    assert_eq!(recorder.total_episodes(&resumed.replay).count, 7 + 2);
    let mean_k = recorder.k_spread(&resumed.replay).unwrap().mean;
    assert_eq!(mean_k, 1.75);
    let read = |frames_max| {
        let header = Table::read(&path).unwrap().header;
        rows_up_to(&path, header, kept(99, frames_max)).unwrap().0
    };
    assert_eq!(read(2_050).rows.len(), 2);
    let rows = read(9_999);
    let column = |name| -> Vec<f64> {
        let values = rows.rows.iter().map(|row| rows.value(row, name).unwrap());
        values.collect()
    };
    assert_eq!(column("frames"), [1_000.0, 2_000.0, 2_100.0]);
    assert_eq!(column("episodes"), [1.0, 7.0, 9.0]);
    assert_eq!(column("mean_k"), [1.5, 1.5, 1.75]);
    // The mean squares 2.5 and 4 average to 3.25; 1.75^2 is 3.0625.
    assert_eq!(column("sd_k"), [0.5, 0.5, 0.433013]);
    assert!(column("seconds").is_sorted());
}

/// Rows that agree with the checkpoint stay, under the columns of the processes that the run has now. Other rows are set aside, and
/// the seconds that they took count.
#[test]
fn rows_past_a_resume_point_are_set_aside_and_good_ones_stay() {
    let episodes = "seconds,frames,episode,actor,env,return,length\n1.0,900,1,0,0,1,3\n2.0,2000,2,0,1,1,3\n3.0,2400,3,0,2,1,3\n";
    let metrics = "seconds,frames,updates,episodes,rss_mib_actor_7\n1.0,900,10,1,5\n2.5,2000,31,2,5\n29.7,2400,50,3,5\n";
    let cases = [
        ("both", Some(metrics), 29.0, 2),
        ("no metrics", None, 0.0, 0),
    ];
    for (what, metrics, seconds, kept) in cases {
        let (_root, run) = run_folder();
        fs::write(run.episodes(), episodes).unwrap();
        if let Some(text) = metrics {
            fs::write(run.metrics(), text).unwrap();
        }
        let recorder = open(&run, &["actor-0"], Some(point(31))).unwrap();
        let aside = fs::read_to_string(run.path().join("episodes.aside-1.csv")).unwrap();
        assert!(aside.ends_with("length\n3.0,2400,3,0,2,1,3\n"), "{aside}");
        let rows = |name: &str| Table::read(&run.path().join(name)).unwrap().rows.len();
        assert_eq!(rows("episodes.csv"), 2, "{what}");
        assert_eq!(rows("episodes.aside-1.csv"), 1, "{what}");
        let rows_of_metrics = (rows("metrics.csv"), rows("metrics.aside-1.csv"));
        assert_eq!(rows_of_metrics, (kept, kept / 2), "{what}");
        let nothing = ReplayStatus::default();
        assert_eq!(recorder.total_episodes(&nothing).count, 2, "{what}");
        let mut view = view(nothing, LearnerStatus::default());
        let summary = recorder.summarise(Outcome::Finished, &mut view);
        let took = summary.wall_seconds;
        assert!(took >= seconds, "{what}: {took}");
        assert_eq!(summary.frames, 2_000, "{what}");
        drop(recorder);

        // A second resume from the same point sets rows aside in another file, and remembers the time.
        fs::write(run.episodes(), episodes).unwrap();
        let recorder = open(&run, &["actor-0"], Some(point(31))).unwrap();
        assert!(recorder.seconds() >= seconds, "{what}");
        assert_eq!(rows("episodes.aside-2.csv"), 1, "{what}");
    }
}

/// The replay fills again, from the checkpoint's frames, or from 0 if nothing was learned.
#[test]
fn rows_of_frames_that_a_resumed_run_makes_again_are_set_aside() {
    let at_start = ResumePoint::default();
    let in_lockstep = ResumePoint {
        frames: 320,
        frames_max: 320,
        replay_is_kept: true,
        ..at_start
    };
    let with_log = ResumePoint {
        frames_max: 9_999,
        ..in_lockstep
    };
    for (metrics, point, kept, episodes) in [
        ("1.0,700,0,2\n", at_start, 0, 0),
        // The kept replay counts the episodes.
        ("1.0,320,0,2\n1.5,800,0,3\n", in_lockstep, 1, 0),
        ("1.0,320,0,2\n1.5,800,0,3\n", with_log, 2, 0),
        ("1.0,1900,31,2\n1.5,2300,31,3\n", point(31), 1, 2),
    ] {
        let (_root, run) = run_folder();
        let text = format!("seconds,frames,updates,episodes\n{metrics}");
        fs::write(run.metrics(), text).unwrap();
        let recorder = open(&run, &[], Some(point)).unwrap();
        let rows = Table::read(&run.metrics()).unwrap().rows;
        assert_eq!(rows.len(), kept, "{metrics}");
        let counted = recorder.total_episodes(&ReplayStatus::default()).count;
        assert_eq!(counted, episodes, "{metrics}");
    }
}

fn summary(replay: ReplayStatus) -> Summary {
    let view = view(replay, LearnerStatus::default());
    Summary::new(Outcome::Finished, &view, 2.0, ResumePoint::default())
}

#[test]
fn next_steps_stand_in_columns() {
    let replay = make(|it: &mut ReplayStatus| it.transitions_inserted = 1_280);
    let earned = |mean, low, high| ReturnInterval { mean, low, high };
    let mut summary = summary(replay);
    summary.played = Some(LastPlay {
        weights: "averaged".into(),
        episodes: 100,
        agent: earned(45.123, 41.8, 48.4),
        random: earned(3.9, 3.1, 4.7),
    });
    expect![[r#"
        Greedy return (averaged weights): 45.12, 95% interval 41.80 to 48.40, 100 episodes; a random policy earns 3.90 (3.10 to 4.70).
          driml evaluate runs/x --record play.gif     films the agent
          driml plot runs/x --out plot.png            return, losses, k and speed
          driml train --resume runs/x --frames 2560   continues training
    "#]]
    .assert_eq(&summary.next_steps(&RunFolder::new("runs/x"), true));
    let repeated_alone = summary.next_steps(&RunFolder::new("runs/x"), false);
    assert!(!repeated_alone.contains("--resume"), "{repeated_alone}");
}

/// The time may come from a file or another process. No episode has ended.
#[test]
fn a_time_that_cannot_be_is_left_out() {
    let possible = " in 2 s (0 frames/s, 0.00 updates/s)";
    for (wall_seconds, time) in [(2.0, possible), (-1.0, ""), (1e300, ""), (f64::NAN, "")] {
        let mut summary = summary(ReplayStatus::default());
        summary.wall_seconds = wall_seconds;
        let said =
            format!("finished: 0 frames and 0 updates{time}, replay ratio -, no episode ended");
        assert_eq!(summary.describe_counts(), said);
    }
}
