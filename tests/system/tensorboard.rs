//! `driml local --tensorboard`: event files as TensorBoard itself reads them, compared with the rows of `metrics.csv`.
//! The framing and checksums of records are tested beside the code that writes them.

use std::collections::BTreeMap;

use driml_tests::{
    TestSystem,
    python::{find_python, run_script},
};
use serde_json::Value;

use crate::system;

/// A script that prints what TensorBoard finds in a folder: points of curves, histograms, sizes of pictures.
const READ_EVENTS: &str = "
import json, sys
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
events = EventAccumulator(sys.argv[1], size_guidance={'scalars': 0, 'histograms': 0, 'images': 0}).Reload()
tags = events.Tags()
histograms = {tag: [[it.step, it.histogram_value.num, it.histogram_value.sum] for it in events.Histograms(tag)] for tag in tags['histograms']}
pictures = {tag: [[it.step, it.width, it.height, it.encoded_image_string[:4].hex()] for it in events.Images(tag)] for tag in tags['images']}
print(json.dumps({
    'scalars': {tag: [[it.step, it.value] for it in events.Scalars(tag)] for tag in tags['scalars']},
    'histograms': histograms,
    'images': pictures,
}))
";

/// Returns the columns of `metrics.csv` without empty cells, as pairs of frames and value.
fn metric_columns(system: &TestSystem) -> BTreeMap<String, Vec<(u64, f64)>> {
    let metrics = system.run_folder("run").table("metrics.csv");
    let mut columns = BTreeMap::<_, Vec<_>>::new();
    for row in &metrics.rows {
        let frames: u64 = metrics.value(row, "frames").unwrap();
        for (name, cell) in metrics.header.iter().zip(row) {
            if let Ok(value) = cell.parse() {
                let column = columns.entry(name.clone()).or_default();
                column.push((frames, value));
            }
        }
    }
    columns.remove("frames");
    columns
}

fn read_events(python: &str, system: &TestSystem) -> Value {
    let folder = system.path("run").display().to_string();
    serde_json::from_str(&run_script(python, &["-c", READ_EVENTS], &[&folder])).unwrap()
}

/// Checks that each number in the rows is a point of the curve with its name, and that there are no other points.
fn check_points(read: &Value, columns: &BTreeMap<String, Vec<(u64, f64)>>) {
    let curves = read["scalars"].as_object().unwrap();
    let names: Vec<_> = curves
        .keys()
        .map(|tag| tag.split_once('/').unwrap().1)
        .collect();
    assert_eq!(names.len(), columns.len(), "{names:?}");
    for (tag, points) in curves {
        let rows = &columns[tag.split_once('/').unwrap().1];
        let points = points.as_array().unwrap();
        assert_eq!(points.len(), rows.len(), "{tag}");
        for (point, (frames, value)) in points.iter().zip(rows) {
            assert_eq!(point[0].as_u64().unwrap(), *frames, "{tag}");
            let off = (point[1].as_f64().unwrap() - value).abs();
            assert!(off <= 1e-6 * value.abs(), "{tag}: {point}, {value}");
        }
    }
}

#[test]
fn tensorboard_reads_what_a_run_recorded_and_continues_recording() {
    let Some(python) = find_python(&["tensorboard"]) else {
        return;
    };
    let system = system();
    let flags =
        "--lockstep --env mspacman --agent driml-ada --preset smoke --frames 320 --tensorboard";
    let summary = system.train(flags, "run");
    let first = read_events(&python, &system);
    check_points(&first, &metric_columns(&system));
    let counted = |tag: &str| -> u64 {
        let all = first["histograms"][tag].as_array().unwrap();
        all.iter().map(|it| it[1].as_f64().unwrap() as u64).sum()
    };
    let served: u64 = summary.replay.k_histogram.iter().sum();
    assert_eq!(counted("k/served"), served);
    assert_eq!(counted("actions/stored"), summary.frames);
    let picture = first["images"]["affinity/A"]
        .as_array()
        .unwrap()
        .last()
        .unwrap();
    assert_eq!(picture[3], "89504e47", "a PNG");
    assert!(picture[1].as_u64().unwrap() >= 5 * 24);

    system.run_ok("local --resume run --frames 480");
    let second = read_events(&python, &system);
    let columns = metric_columns(&system);
    check_points(&second, &columns);
    assert_eq!(columns["mean_age"].last().unwrap().0, 480);
    let names = system.file_names("run").into_iter();
    let files = names.filter(|name| name.contains("tfevents"));
    assert_eq!(files.count(), 2, "a file for each time it was started");
}
