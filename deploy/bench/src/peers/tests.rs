//! The comparison's arithmetic and its table, without any measurement.

use driml_learner::Precision;
use expect_test::expect;

use super::*;

fn figure(what: &str, value: f64) -> Measurement {
    Measurement::found(what, value, "updates/s")
}

fn samples(of: &[(&str, &[f64])]) -> Samples {
    of.iter()
        .map(|(what, values)| (what.to_string(), values.to_vec()))
        .collect()
}

fn pair(theirs: Theirs, goal: Option<f64>) -> Pair {
    Pair {
        component: Component::Learner,
        ours: "C51",
        theirs,
        goal,
    }
}

#[test]
fn a_ratio_is_the_median_of_the_rounds_ratios() {
    let mut sides = Sides {
        ours: samples(&[("C51", &[6.0, 4.0, 9.0]), ("stock", &[0.5, 0.5, 0.5])]),
        ..Sides::default()
    };
    sides.units.insert("C51".into(), "updates/s".into());
    for value in [3.0, 4.0, 3.0] {
        sides.add_theirs("PyTorch 9".into(), [("C51".into(), value)].into());
    }
    let found = row(&pair(Theirs::Peers("C51"), Some(1.5)), &sides).unwrap();
    assert_eq!(
        (found.ours, found.theirs, found.ratio),
        (6.0, Some(3.0), Some(2.0))
    );
    assert_eq!((found.peer.as_str(), found.skipped), ("PyTorch 9", None));
    let found = row(&pair(Theirs::Ours("stock", "stock"), None), &sides).unwrap();
    assert_eq!((found.ratio, found.peer.as_str()), (Some(12.0), "stock"));
}

#[test]
fn a_peer_that_is_missing_is_shown_as_skipped() {
    let mut sides = Sides {
        peer: "PyTorch".into(),
        absent: Some("python3 has no PyTorch".into()),
        ..Sides::default()
    };
    sides.add_ours(vec![figure("C51", 6.0)]);
    let rows = vec![row(&pair(Theirs::Peers("C51"), Some(1.5)), &sides).unwrap()];
    assert_eq!((rows[0].ratio, rows[0].theirs), (None, None));
    let comparison = Comparison {
        rounds: 1,
        quick: true,
        threads: 2,
        machine: MachineNote {
            processor: "a processor".into(),
            cores: 2,
            load: 6.6,
            gpu: None,
        },
        rows,
    };
    expect![[r#"
        what  ours  theirs                      ratio  goal
        C51   6.00       -  updates/s  PyTorch      -  1.50  skipped
        skipped: python3 has no PyTorch
        Medians of 1 rounds of ours, theirs; the ratio is the median of the rounds' ratios. 2 threads; a processor, 2 cores.
        The machine was not idle before: 6.60 tasks wanted a core. These are no figures to go by.
        Quick: a few iterations only, no figures to go by.
    "#]]
    .assert_eq(&describe(&comparison));
    let text = serde_json::to_string(&comparison).unwrap();
    assert_eq!(
        serde_json::from_str::<Comparison>(&text).unwrap(),
        comparison
    );
}

#[test]
fn every_peer_s_figure_is_named_in_its_script() {
    for Pair {
        component, theirs, ..
    } in PAIRS
    {
        let Theirs::Peers(name) = theirs else {
            continue;
        };
        // Names that a script puts together are checked by running it; the precision is one it appends.
        let name = name.strip_suffix(", bf16").unwrap_or(name);
        if matches!(component, Component::Learner | Component::Replay) {
            let quoted = format!("\"{name}\"");
            let scripts = script::texts();
            assert!(scripts.iter().any(|text| text.contains(&quoted)), "{name}");
        }
    }
}

#[test]
fn rows_of_a_precision_that_was_not_asked_for_are_left_out() {
    let asked = |precisions: &[Precision]| {
        let learners = PAIRS.iter().filter(|it| it.component == Component::Learner);
        let asked = learners.filter(|pair| pair.is_asked(precisions));
        asked.map(|pair| pair.ours).collect::<Vec<_>>()
    };
    let (f32, bf16) = (asked(&[Precision::F32]), asked(&[Precision::Bf16]));
    assert!(bf16.iter().all(|name| name.ends_with(", bf16")));
    assert!(!f32.iter().any(|name| name.contains("bf16")));
    let all = asked(&[Precision::F32, Precision::Bf16]);
    assert_eq!(f32.len() + bf16.len(), all.len());
    assert!(!f32.is_empty() && !bf16.is_empty());
}
