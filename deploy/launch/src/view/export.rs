//! Exports a run for programs: one JSON object, and a file in Prometheus' text format for node_exporter's textfile collector.
//! This module serves no requests.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::PathBuf,
};

use clap::Args;
use driml_machine::error::Usage;
use driml_protocol::{LearnerStatus, ProcessStatus, ReplayStatus};
use serde::Serialize;

use super::{
    advice::{actions_needed, limiter_waits},
    poll::Poller,
};
use crate::{
    metrics::{self, COLUMNS, Member, Value},
    output::write_file,
    run_view::{Plan, RunView, ServerAnswer},
};

#[derive(Serialize)]
struct RunJson<'a> {
    #[serde(flatten)]
    plan: &'a Plan,
    healthy: bool,
    finished: bool,
    #[serde(flatten)]
    metrics: BTreeMap<&'static str, serde_json::Value>,
    servers: &'a [ServerAnswer],
    replay: &'a ReplayStatus,
    learner: Option<&'a LearnerStatus>,
    /// Which side waits and since when, in sentences.
    waiting_for: Vec<String>,
    /// What is missing and what to do about it, in sentences.
    actions_needed: Vec<String>,
}

pub(crate) fn run_json(view: &RunView) -> serde_json::Result<String> {
    let actions_needed = actions_needed(view);
    let answer = RunJson {
        plan: &view.plan,
        healthy: actions_needed.is_empty(),
        finished: view.is_finished(),
        metrics: metrics::json(view),
        servers: &view.servers,
        replay: &view.replay,
        learner: view.learner_status(),
        waiting_for: limiter_waits(view),
        actions_needed,
    };
    Ok(serde_json::to_string(&answer)? + "\n")
}

/// The file for Prometheus. Each write replaces it, whole or not at all.
#[derive(Debug, Default, Args)]
pub(crate) struct PrometheusFlag {
    /// Replace this file with the metrics in Prometheus' text format at each request; for node_exporter's textfile collector, which
    /// reads files named *.prom
    #[arg(long, value_name = "FILE")]
    prometheus: Option<PathBuf>,
}

impl PrometheusFlag {
    /// If no run was `found`, writes that none answers.
    pub(crate) fn check_found(&self, found: anyhow::Result<Poller>) -> anyhow::Result<Poller> {
        if found.is_err() {
            self.write_text("# TYPE driml_up gauge\ndriml_up 0\n")?;
        }
        found
    }

    pub(crate) fn write(&self, view: &RunView) -> Result<(), Usage> {
        self.write_text(&prometheus_text(view))
    }

    fn write_text(&self, text: &str) -> Result<(), Usage> {
        let path = self.prometheus.as_deref();
        path.map_or(Ok(()), |it| write_file("--prometheus", it, text.as_bytes()))
    }
}

/// The text of the file. Labels on each line distinguish the runs of one machine.
fn prometheus_text(view: &RunView) -> String {
    let (plan, endpoints) = (&view.plan, view.servers.iter().map(|it| &*it.endpoint));
    let mut page = PrometheusText {
        text: String::new(),
        labels: format!(
            "world=\"{}\",agent=\"{}\",seed=\"{}\",endpoint=\"{}\"",
            escaped(&plan.world),
            escaped(&plan.agent),
            plan.seed,
            escaped(&endpoints.collect::<Vec<_>>().join(" "))
        ),
    };
    let up = view.servers_answered().into();
    page.add_gauge("up", "Whether all replay servers of the run answered.", up);
    // The counts of only some servers are not those of the run.
    if view.servers_answered() {
        page.add_columns(view);
        page.add_processes(view);
        let planned = [plan.frames_planned, plan.updates_planned].map(|it| it as f64);
        page.add_gauge("frames_planned", "Frames of the whole run.", planned[0]);
        page.add_gauge("updates_planned", "Updates of the whole run.", planned[1]);
        let help = "Whether all updates are made and saved.";
        page.add_gauge("finished", help, view.is_finished().into());
        let help = "Whether `driml status` exits with code 0.";
        page.add_gauge("healthy", help, actions_needed(view).is_empty().into());
    }
    page.text
}

struct PrometheusText {
    text: String,
    labels: String,
}

impl PrometheusText {
    /// Adds a metric: its head, and a sample for each member that has a value; nothing if none has. `label` distinguishes members. The
    /// name of a counter, and of no gauge, ends in `_total`.
    fn add_metric(&mut self, name: &str, help: &str, label: &str, members: &[Member]) {
        let kind = match name.ends_with("_total") {
            true => "counter",
            false => "gauge",
        };
        let members = members.iter();
        let known = members.filter_map(|(member, value)| Some((member, (*value)?)));
        for (nth, (member, value)) in known.enumerate() {
            if nth == 0 {
                self.text += &format!("# HELP driml_{name} {help}\n# TYPE driml_{name} {kind}\n");
            }
            let more = match label {
                "" => String::new(),
                label => format!(",{label}=\"{}\"", escaped(member)),
            };
            self.text += &format!("driml_{name}{{{}{more}}} {value}\n", self.labels);
        }
    }

    fn add_gauge(&mut self, name: &str, help: &str, value: f64) {
        self.add_metric(name, help, "", &[(String::new(), Some(value))]);
    }

    fn add_columns(&mut self, view: &RunView) {
        for column in COLUMNS {
            let (label, ending) = match column.value {
                Value::Counter(_) => ("", "_total"),
                Value::Members { label, .. } => (label, ""),
                Value::Gauge(_) | Value::Words(_) => ("", ""),
            };
            let name = format!("{}{ending}", column.name);
            self.add_metric(&name, column.help, label, &column.members(view));
        }
    }

    fn add_processes(&mut self, view: &RunView) {
        let statuses = view.servers.iter().filter_map(|it| it.processes.as_ref());
        // With several shards, each server reports the learner.
        let mut seen = BTreeSet::new();
        let processes = statuses.flat_map(|it| &it.processes);
        let processes: Vec<_> = processes.filter(|it| seen.insert(it.who)).collect();
        let mut each = |name, help, value: fn(&ProcessStatus) -> Option<f64>| {
            let members = processes.iter().map(|it| (it.who.to_string(), value(it)));
            self.add_metric(name, help, "process", &members.collect::<Vec<_>>());
        };
        let up = "Whether a process that has joined the run is connected.";
        each("process_connected", up, |it| Some(it.connected.into()));
        let joined = "How often a process has joined the run.";
        each("process_joined_total", joined, |it| Some(it.lives.into()));
        let silent = "Seconds since the last chunk or request for a batch of a process.";
        each("process_silent_seconds", silent, |it| it.last_seen_s);
    }
}

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
