//! A run for programs: one JSON object, and Prometheus' text format in a file that node_exporter's textfile collector reads.
//! Nothing is served.

use std::{
    collections::BTreeMap,
    fmt::{Display, Write},
    path::{Path, PathBuf},
};

use driml_protocol::{LearnerStatus, ReplayStatus, whole_file};
use serde::Serialize;

use super::advice::{needed, waits};
use crate::{
    metrics::{self, COLUMNS, Value},
    run_view::{Plan, RunView, ServerAnswer},
};

/// The object that `--json` prints.
#[derive(Serialize)]
struct Answer<'a> {
    #[serde(flatten)]
    plan: &'a Plan,
    /// Nothing is missing.
    well: bool,
    /// Everything is learned and saved.
    finished: bool,
    #[serde(flatten)]
    metrics: BTreeMap<&'static str, serde_json::Value>,
    servers: &'a [ServerAnswer],
    replay: &'a ReplayStatus,
    learner: Option<&'a LearnerStatus>,
    /// Which side waits and since when, in sentences.
    waits: Vec<String>,
    /// What is missing and what to do about it, in sentences.
    to_go_on: Vec<String>,
}

/// The run as one line of JSON.
pub(crate) fn json(view: &RunView) -> serde_json::Result<String> {
    let to_go_on = needed(view);
    let answer = Answer {
        plan: &view.plan,
        well: to_go_on.is_empty(),
        finished: view.is_finished(),
        metrics: metrics::json(&view.moment()),
        servers: &view.servers,
        replay: &view.replay,
        learner: view.learner_status(),
        waits: waits(view),
        to_go_on,
    };
    Ok(serde_json::to_string(&answer)? + "\n")
}

/// The file for Prometheus, which is written anew at each answer.
pub(crate) struct PrometheusFile {
    path: PathBuf,
    /// It could not be written, and a line says so.
    has_warned: bool,
}

impl PrometheusFile {
    pub(crate) fn new(path: &Path) -> Self {
        Self {
            path: path.into(),
            has_warned: false,
        }
    }

    /// Writes it, whole or not at all. A warning is returned the first time that it cannot be written.
    pub(crate) fn write(&mut self, view: &RunView) -> Option<String> {
        let failed = whole_file::write(&self.path, prometheus(view).as_bytes()).err()?;
        (!std::mem::replace(&mut self.has_warned, true))
            .then(|| format!("{} cannot be written: {failed}", self.path.display()))
    }
}

/// The text, with labels on each line that tell one run from another of the same machine.
fn prometheus(view: &RunView) -> String {
    let (plan, endpoints) = (&view.plan, view.servers.iter().map(|it| &*it.endpoint));
    let mut page = Page {
        text: String::new(),
        labels: format!(
            "world=\"{}\",agent=\"{}\",seed=\"{}\",endpoint=\"{}\"",
            escaped(&plan.world),
            escaped(&plan.agent),
            plan.seed,
            escaped(&endpoints.collect::<Vec<_>>().join(" "))
        ),
    };
    let flag = |is_set: bool| f64::from(u8::from(is_set));
    let up = flag(view.is_answered());
    page.gauge("up", "Whether all replay servers of the run answered.", up);
    // What only some of them count is not the run's.
    if view.is_answered() {
        page.columns(view);
        page.processes(view);
        for (name, help, value) in [
            (
                "frames_planned",
                "Frames of the whole run.",
                plan.frames_planned as f64,
            ),
            (
                "updates_planned",
                "Updates of the whole run.",
                plan.updates_planned as f64,
            ),
            (
                "finished",
                "Whether everything is learned and saved.",
                flag(view.is_finished()),
            ),
            (
                "well",
                "Whether no process of the run is missing.",
                flag(needed(view).is_empty()),
            ),
        ] {
            page.gauge(name, help, value);
        }
    }
    page.text
}

struct Page {
    text: String,
    labels: String,
}

impl Page {
    fn head(&mut self, name: &str, kind: &str, help: &str) {
        // Writing to a string cannot fail.
        let _ = writeln!(
            self.text,
            "# HELP driml_{name} {help}\n# TYPE driml_{name} {kind}"
        );
    }

    fn sample(&mut self, name: &str, more: &str, value: impl Display) {
        let labels = &self.labels;
        let _ = writeln!(self.text, "driml_{name}{{{labels}{more}}} {value}");
    }

    fn gauge(&mut self, name: &str, help: &str, value: f64) {
        self.head(name, "gauge", help);
        self.sample(name, "", value);
    }

    /// One sample for each member of a family that has a value; nothing if none has.
    fn family(
        &mut self,
        (name, kind, help): (&str, &str, &str),
        label: &str,
        members: &[(String, f64)],
    ) {
        if !members.is_empty() {
            self.head(name, kind, help);
        }
        for (member, value) in members {
            self.sample(name, &format!(",{label}=\"{}\"", escaped(member)), value);
        }
    }

    fn columns(&mut self, view: &RunView) {
        let moment = view.moment();
        for column in COLUMNS {
            let known = column.members(&moment).into_iter();
            let known = known.filter_map(|it| Some((it.name, it.value?)));
            let known: Vec<_> = known.collect();
            match (column.value, &known[..]) {
                (Value::Each { label, .. }, members) => {
                    self.family((column.name, "gauge", column.help), label, members);
                }
                (Value::Counter(_), [(name, value)]) => {
                    let name = format!("{name}_total");
                    self.head(&name, "counter", column.help);
                    self.sample(&name, "", value);
                }
                (_, [(name, value)]) => self.gauge(name, column.help, *value),
                _ => {}
            }
        }
    }

    fn processes(&mut self, view: &RunView) {
        let accounts = view.servers.iter().filter_map(|it| it.parts.as_ref());
        // With several shards the learner takes part in each.
        let mut seen = std::collections::BTreeSet::new();
        let parts = accounts.flat_map(|it| &it.parts);
        let parts: Vec<_> = parts.filter(|it| seen.insert(it.who)).collect();
        let each = |value: fn(&driml_protocol::PartStatus) -> Option<f64>| -> Vec<_> {
            let known = parts.iter();
            let known = known.filter_map(|it| Some((it.who.to_string(), value(it)?)));
            known.collect()
        };
        for (family, members) in [
            (
                (
                    "part_connected",
                    "gauge",
                    "Whether a process that has joined the run is connected.",
                ),
                each(|it| Some(u8::from(it.connected).into())),
            ),
            (
                (
                    "part_joined_total",
                    "counter",
                    "How often a process has joined the run.",
                ),
                each(|it| Some(it.lives.into())),
            ),
            (
                (
                    "part_silent_seconds",
                    "gauge",
                    "Seconds since the last chunk or request for a batch of a process.",
                ),
                each(|it| it.heard_s),
            ),
        ] {
            self.family(family, "part", &members);
        }
    }
}

/// A label's value.
fn escaped(text: &str) -> String {
    let text = text.replace('\\', "\\\\").replace('"', "\\\"");
    text.replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_labels_are_escaped() {
        assert_eq!(escaped("exec:a \"b\\c\"\n"), "exec:a \\\"b\\\\c\\\"\\n");
    }
}
