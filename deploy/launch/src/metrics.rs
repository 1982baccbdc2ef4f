//! Every metric of a run, defined once in [`COLUMNS`]. `metrics.csv`, `--json`, Prometheus' file, TensorBoard's events and the labels
//! of plots loop over this table.
//! This module asks no process and writes no file.

use std::collections::BTreeMap;

use driml_protocol::LearnerStatus;

use crate::run_view::RunView;

/// A metric: its column in `metrics.csv`, or its columns if it has several members.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    /// The metric's name in `metrics.csv` and in JSON. In Prometheus it is `driml_NAME`, or `driml_NAME_total` for a counter.
    pub name: &'static str,
    pub(crate) help: &'static str,
    /// The unit of the metric's numbers.
    pub unit: &'static str,
    /// The title of the metric's chart.
    pub plot_label: &'static str,
    /// The group in which TensorBoard shows the curve.
    pub(crate) group: &'static str,
    pub(crate) value: Value,
}

/// How a metric is read from a view of a run. The result is none where the value is not known yet.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Value {
    /// A number that only rises until the run is started anew; for faults and waits, until it is resumed without its replay.
    Counter(fn(&RunView) -> Option<f64>),
    Gauge(fn(&RunView) -> Option<f64>),
    /// A gauge with several members, such as the auxiliary losses: a column per member, named `prefix` and the member's name.
    Members {
        /// The Prometheus label that distinguishes the members.
        label: &'static str,
        prefix: &'static str,
        members: fn(&RunView) -> Vec<Member>,
    },
    /// Words, which only `metrics.csv` and JSON contain.
    Words(fn(&RunView) -> String),
}

/// A member's name, and its value in the metric's unit; none if it is not known.
pub(crate) type Member = (String, Option<f64>);

/// Makes [`COLUMNS`]. A row has a metric's name, unit, group and title, then its help text, then how its value is read.
macro_rules! columns {
    ($($name:literal, $unit:literal, $group:literal, $plot_label:literal: $help:literal, $value:expr;)+) => {
        /// All metrics, in the order of the columns of `metrics.csv`. The auxiliary losses stand between C51's loss and the total.
        pub const COLUMNS: &[Column] = &[$(Column {
            name: $name,
            help: $help,
            unit: $unit,
            plot_label: $plot_label,
            group: $group,
            value: $value,
        }),+];
    };
}

columns! {
    "seconds", "seconds", "run", "Time":
        "Time since the run began, without interruptions.",
        Value::Counter(|it| it.recorded_s.or_else(|| it.uptime_s()));
    "frames", "frames", "run", "Frames":
        "Transitions that the replay has stored.",
        Value::Counter(|it| Some(it.replay.transitions_inserted as f64));
    "updates", "updates", "run", "Updates":
        "Updates of the learner.",
        Value::Counter(updates);
    "frames_per_second", "frames per second", "speed", "Acting speed":
        "Frames a second, over the last 20 seconds.",
        Value::Gauge(|it| it.speed.map(|it| it.frames));
    "updates_per_second", "updates per second", "speed", "Learning speed":
        "Updates a second, over the last 20 seconds.",
        Value::Gauge(|it| it.speed.map(|it| it.updates));
    "replay_ratio", "rows sampled per transition", "run", "Replay ratio":
        "Rows sampled per transition stored, both since the warm-up.",
        Value::Gauge(|it| it.replay.replay_ratio());
    "episodes", "episodes", "return", "Episodes":
        "Training episodes that ended.",
        Value::Counter(|it| Some(it.episodes.count as f64));
    "mean_return", "mean of the last 100 episodes", "return", "Return":
        "Mean undiscounted return of the newest training episodes.",
        Value::Gauge(|it| it.episodes.mean_return);
    "mean_return_of", "episodes", "return", "Episodes in the mean return":
        "Episodes in the mean return: 100, or as many as there were.",
        Value::Gauge(|it| Some(it.episodes.mean_return_of as f64));
    "c51_kl", "KL divergence [nats]", "learning", "C51 loss":
        "C51's loss of the last update.",
        Value::Gauge(|it| last_update(it, |it| it.c51_kl.into()));
    "losses", "auxiliary loss [nats]", "learning", "Auxiliary loss":
        "The last update's auxiliary losses, a column each, such as `dim_4t4`.",
        Value::Members { label: "loss", prefix: "", members: losses };
    "total_loss", "loss [nats]", "learning", "Total loss":
        "The total loss of the last update.",
        Value::Gauge(|it| last_update(it, |it| it.total.into()));
    "grad_norm", "global 2-norm", "learning", "Gradient before clipping":
        "Norm of the last update's gradient before clipping.",
        Value::Gauge(|it| last_update(it, |it| it.grad_norm));
    "q_mean", "discounted return", "learning", "Mean Q value":
        "Mean value of the actions that the last update's rows took.",
        Value::Gauge(|it| last_update(it, |it| it.q_mean.into()));
    "mean_k", "k [environment steps]", "k", "How far ahead: k, mean since the start":
        "Mean k since the start, over positives; of several the furthest.",
        Value::Gauge(|it| it.k.map(|it| it.mean));
    "sd_k", "environment steps", "k", "Standard deviation of k":
        "Standard deviation of k over the same rows.",
        Value::Gauge(|it| it.k.map(|it| it.sd));
    "mean_age", "transitions", "run", "Age of sampled rows":
        "Mean age of the rows served last: transitions stored since theirs.",
        Value::Gauge(|it| Some(it.replay.mean_age));
    "weights_version", "version", "run", "Version of the weights":
        "Version of the newest weights.",
        Value::Gauge(|it| it.learner_shown().map(|it| it.weights_version as f64));
    "affinity_version", "version", "run", "Version of the affinity":
        "Version of the affinity in use; 0 is the uniform one.",
        Value::Gauge(|it| Some(it.replay.affinity_version as f64));
    "actors", "actors", "run", "Actors":
        "Actors that are connected.",
        Value::Gauge(|it| Some(it.replay.actors.into()));
    "waiting", "words", "run", "Waiting":
        "Which side waits at the rate limiter.",
        Value::Words(|it| it.replay.waiting.to_string());
    "epsilon", "probability of a random action", "run", "Epsilon":
        "Probability of a random action; empty where actors differ in it.",
        Value::Gauge(|it| Some(it.plan.epsilon?.epsilon(it.replay.transitions_inserted)));
    "transitions_lost", "transitions", "faults", "Lost transitions":
        "Transitions that actors produced and that never arrived.",
        Value::Counter(|it| Some(it.replay.transitions_lost as f64));
    "transitions_duplicated", "transitions", "faults", "Duplicated transitions":
        "Transitions stored twice.",
        Value::Counter(|it| Some(it.replay.transitions_duplicated as f64));
    "messages_refused", "messages", "faults", "Rejected messages":
        "Messages rejected as malformed or foreign, or because of their sender's role.",
        Value::Counter(|it| Some(it.replay.messages_refused as f64));
    "learner_waited_seconds", "seconds", "speed", "Time that the learner waited":
        "Time that requests for a batch waited at the rate limiter.",
        Value::Counter(|it| Some(it.replay.learner_waited_s));
    "actors_waited_seconds", "seconds", "speed", "Time that actors waited":
        "Time that chunks waited at the rate limiter, summed over actors.",
        Value::Counter(|it| Some(it.replay.actors_waited_s));
    "rss_mib", "resident memory [MiB]", "memory", "Memory":
        "Resident memory of each process, such as `rss_mib_actor_0`.",
        Value::Members { label: "process", prefix: "rss_mib_", members: |it| it.rss_mib.clone() };
}

fn updates(it: &RunView) -> Option<f64> {
    // A recorded row needs a number, even if the learner is down since before the first one.
    let is_needed = it.replay.learner_finished || it.recorded_s.is_some();
    let last_known = is_needed.then_some(it.replay.updates);
    let updates = it.learner_shown().map(|it| it.updates).or(last_known);
    updates.map(|it| it as f64)
}

/// A number of the last update; none before the first update, as a 0 would look like a loss.
fn last_update(it: &RunView, value: fn(&LearnerStatus) -> f64) -> Option<f64> {
    it.learner_shown().filter(|it| it.updates > 0).map(value)
}

fn losses(it: &RunView) -> Vec<Member> {
    let loss = |name: &str| it.learner_shown()?.loss(name).map(f64::from);
    let losses = it.plan.losses.iter();
    losses.map(|&name| (name.into(), loss(name))).collect()
}

impl Column {
    /// The numbers of the metric: one under its name, or one per member; empty for words.
    pub(crate) fn members(&self, view: &RunView) -> Vec<Member> {
        match self.value {
            Value::Counter(value) | Value::Gauge(value) => vec![(self.name.into(), value(view))],
            Value::Members { members, .. } => members(view),
            Value::Words(_) => Vec::new(),
        }
    }

    fn csv_name(&self, member: &str) -> String {
        match self.value {
            Value::Members { prefix, .. } => prefix.to_owned() + &member.replace('-', "_"),
            _ => member.to_owned(),
        }
    }
}

/// The text of a cell; empty if the value is not known.
pub(crate) fn cell(value: Option<impl ToString>) -> String {
    value.map_or(String::new(), |it| it.to_string())
}

pub(crate) fn csv_cells(view: &RunView) -> Vec<(String, String)> {
    let cells = COLUMNS.iter().flat_map(|column| match column.value {
        Value::Words(words) => vec![(column.name.to_owned(), words(view))],
        _ => {
            let members = column.members(view).into_iter();
            let cells =
                members.map(|(name, value)| (column.csv_name(&name), cell(value.map(rounded))));
            cells.collect()
        }
    });
    cells.collect()
}

/// TensorBoard's curves, named `GROUP/COLUMN`, with their newest points. They are drawn over frames.
pub(crate) fn curve_points(view: &RunView) -> Vec<(String, f64)> {
    let drawn = COLUMNS.iter().filter(|it| it.name != "frames");
    let points = drawn.flat_map(|column| {
        let curve = |name: &str| format!("{}/{}", column.group, column.csv_name(name));
        let members = column.members(view).into_iter();
        members.filter_map(move |(name, value)| Some((curve(&name), rounded(value?))))
    });
    points.collect()
}

/// The metrics as JSON by name. Whole numbers are integers, unknown values are null, and a metric with several members is an object.
pub(crate) fn json(view: &RunView) -> BTreeMap<&'static str, serde_json::Value> {
    let value = |column: &Column| match column.value {
        Value::Counter(value) | Value::Gauge(value) => value(view).map(json_number).into(),
        Value::Words(words) => words(view).into(),
        Value::Members { members, .. } => {
            let members = members(view).into_iter();
            let known = members.filter_map(|(name, value)| Some((name, json_number(value?))));
            serde_json::Value::Object(known.collect())
        }
    };
    COLUMNS.iter().map(|it| (it.name, value(it))).collect()
}

/// A JSON number; null for NaN and infinity, which JSON does not have.
fn json_number(value: f64) -> serde_json::Value {
    /// Below this, f64 represents every whole number exactly.
    const WHOLE_MAX: f64 = 9_007_199_254_740_992.0;
    match value.fract() == 0.0 && value.abs() < WHOLE_MAX {
        true => (value as i64).into(),
        false => value.into(),
    }
}

/// The metric of a column of `metrics.csv`, also for the memory of a process, whose name differs by run. None for an auxiliary loss.
pub fn find_column(name: &str) -> Option<&'static Column> {
    COLUMNS.iter().find(|it| match it.value {
        Value::Members {
            label: "process", ..
        } => name.starts_with(it.name),
        _ => it.name == name,
    })
}

/// Rounds to six decimals, which drops digits from a conversion of f32: -0.6, not -0.5999999940395355. Small numbers keep seven digits.
pub fn rounded(value: f64) -> f64 {
    let text = match value.abs() < 1e-3 {
        true => format!("{value:.6e}"),
        false => format!("{value:.6}"),
    };
    text.parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use driml_protocol::ReplayStatus;
    use expect_test::expect_file;

    use super::*;
    use crate::{
        run_view::Plan,
        testing::{make, view},
    };

    #[test]
    fn what_is_not_known_is_left_out() {
        let replay = make(|it: &mut ReplayStatus| it.transitions_inserted = 7);
        let learner = make(|it: &mut LearnerStatus| {
            it.losses = vec![("dim_4t4".into(), 2.0)];
            (it.updates, it.c51_kl) = (3, 0.5);
        });
        let plan = make(|it: &mut Plan| it.losses = &["dim_3t3", "dim_4t4"]);
        let mut unknown = view(plan.clone(), replay.clone(), None);
        for name in ["updates", "c51_kl", "frames_per_second"] {
            assert_eq!(json(&unknown)[name], serde_json::Value::Null, "{name}");
        }
        (unknown.recorded_s, unknown.replay.updates) = (Some(1.0), 5);
        assert_eq!(json(&unknown)["updates"], 5);
        assert!(json(&unknown)["c51_kl"].is_null());
        let mut known = view(plan, replay, Some(learner));
        known.rss_mib = vec![("actor-0".into(), Some(12.34)), ("actor-1".into(), None)];
        let text = serde_json::to_string(&json(&known)).unwrap();
        for part in [
            r#""frames":7,"#,
            r#""c51_kl":0.5,"#,
            r#""losses":{"dim_4t4":2},"#,
            r#""rss_mib":{"actor-0":12.34},"#,
            r#""waiting":"neither side waits","#,
        ] {
            assert!(text.contains(part), "{part} in {text}");
        }
        let points = curve_points(&known);
        let of = |name: &str| points.iter().find(|it| it.0 == name).map(|it| it.1);
        assert_eq!(of("memory/rss_mib_actor_0"), Some(12.34));
        assert_eq!(of("memory/rss_mib_actor_1"), None);
        assert_eq!(of("learning/dim_4t4"), Some(2.0));
        assert_eq!(of("run/frames"), None);
    }

    #[test]
    fn small_and_large_numbers_keep_their_digits() {
        let three_f32 = f64::from(-0.2f32) + f64::from(-0.2f32) + f64::from(-0.2f32);
        for (value, text) in [
            (three_f32, "-0.6"),
            (f64::from(0.1f32), "0.1"),
            (12_345.0, "12345"),
            (0.0, "0"),
            (f64::from(1e-7f32), "0.0000001"),
            (4.007, "4.007"),
            (-0.0125, "-0.0125"),
            (123_456.789, "123456.789"),
            (4.2e-7, "0.00000042"),
            (-9.87654321e-4, "-0.0009876543"),
        ] {
            assert_eq!(rounded(value).to_string(), text);
        }
        assert_eq!(rounded(1.5e30), 1.5e30);
        assert!(rounded(f64::NAN).is_nan() && rounded(f64::INFINITY).is_infinite());
    }

    #[test]
    fn a_name_is_one_metric_s_and_none_hides_another() {
        for (at, it) in COLUMNS.iter().enumerate() {
            assert_eq!(find_column(it.name).map(|it| it.name), Some(it.name));
            assert!(COLUMNS[..at].iter().all(|other| other.name != it.name));
            assert!(it.help.ends_with('.') && !it.unit.is_empty(), "{}", it.name);
        }
        assert_eq!(find_column("rss_mib_actor_7").unwrap().name, "rss_mib");
        assert!(find_column("dim_4t4").is_none());
    }

    /// `UPDATE_EXPECT=1` rewrites the page.
    #[test]
    fn the_page_has_every_metric() {
        let mut page = "<!-- Generated: `UPDATE_EXPECT=1 cargo test -p driml-launch --lib metrics` rewrites this page. -->\n\n# Metrics\n\n\
             `metrics.csv` in the run folder has a row per second with these columns. `driml status --json` has the same \
             names. The last column is the name in the file of `driml watch --prometheus FILE`.\n\n\
             | column | unit | meaning | Prometheus |\n| --- | --- | --- | --- |\n".to_owned();
        for column in COLUMNS {
            let prometheus = match column.value {
                Value::Counter(_) => format!("`driml_{}_total`", column.name),
                Value::Gauge(_) => format!("`driml_{}`", column.name),
                Value::Members { label, .. } => format!("`driml_{}{{{label}}}`", column.name),
                Value::Words(_) => "-".into(),
            };
            let (name, unit, help) = (column.name, column.unit, column.help);
            page += &format!("| `{name}` | {unit} | {help} | {prometheus} |\n");
        }
        expect_file!["../../docs/src/reference/metrics.md"].assert_eq(&page);
    }
}
