//! The comparison's arithmetic and its table, without any measurement.

use expect_test::expect;

use super::*;

fn sides(ours: &[(&str, &[f64])]) -> Sides {
    let mut sides = Sides {
        peer: "PyTorch".into(),
        ..Sides::default()
    };
    for (what, values) in ours {
        for value in *values {
            sides.ours.record(*what, *value, "updates/s");
        }
    }
    sides
}

fn pair(theirs: &str, own_figure: Option<&'static str>) -> Pair {
    Pair {
        component: Component::Learner,
        ours: "C51".into(),
        theirs: theirs.into(),
        own_figure,
        goal: Some(1.5),
    }
}

#[test]
fn a_ratio_is_the_median_of_the_rounds_ratios() {
    let mut sides = sides(&[("C51", &[6.0, 4.0, 9.0]), ("stock", &[0.5, 0.5, 0.5])]);
    for value in [3.0, 4.0, 3.0] {
        let (peer, figures) = ("PyTorch 9".into(), [("C51".into(), value)].into());
        sides.add_theirs(Answer { peer, figures });
    }
    let found = compare(&pair("C51", None), &sides).unwrap();
    let numbers = (found.ours, found.theirs, found.ratio);
    assert_eq!(numbers, (6.0, Some(3.0), Some(2.0)));
    assert_eq!((found.peer.as_str(), found.skipped), ("PyTorch 9", None));
    let found = compare(&pair("stock", Some("candle")), &sides).unwrap();
    assert_eq!((found.ratio, found.peer.as_str()), (Some(12.0), "candle"));
}

#[test]
fn a_peer_that_is_missing_is_shown_as_skipped() {
    let mut sides = sides(&[("C51", &[6.0])]);
    sides.skip("python3 has no PyTorch".into());
    let comparison = Comparison {
        rounds: 1,
        quick: true,
        threads: 2,
        machine: MachineInfo {
            processor: "a processor".into(),
            cores: 2,
            load: 6.6,
            gpu: None,
        },
        rows: vec![compare(&pair("C51", None), &sides).unwrap()],
    };
    expect![[r#"
        what  ours  theirs                      ratio  goal
        C51   6.00       -  updates/s  PyTorch      -  1.50  skipped
        skipped: python3 has no PyTorch
        ours, theirs: medians of 1 round; ratio: median of the rounds' ratios. 2 threads; a processor, 2 cores.
        The machine was not idle before: 6.60 tasks wanted a core. These figures are not reliable.
        Quick: a few iterations only; these figures are not reliable.
    "#]]
    .assert_eq(&format_table(&comparison));
    let json = serde_json::to_value(&comparison).unwrap();
    assert_eq!(json["rows"][0]["part"], "learner");
}

#[test]
fn every_peer_s_figure_is_named_in_its_script() {
    let mut checked = 0;
    for pair in pairs() {
        // Names that a script composes are checked by running it. The script also appends the precision.
        let name = pair.theirs.as_str();
        let name = name.strip_suffix(", bf16").unwrap_or(name);
        let is_whole = matches!(pair.component, Component::Learner | Component::Replay);
        if is_whole && pair.own_figure.is_none() {
            let quoted = format!("\"{name}\"");
            let named = |(_, text): &(_, &str)| text.contains(&quoted);
            assert!(script::SCRIPTS.iter().any(named), "{name}");
            checked += 1;
        }
    }
    assert!(checked > 0);
}
