//! A run's numbers in Prometheus' text format, in a file that node_exporter's textfile collector reads.
//! The numbers are those of `--json`; nothing is served.

use std::{
    fmt::{Display, Write},
    path::{Path, PathBuf},
};

use driml_protocol::whole_file;

use crate::status::Snapshot;

/// The file, which is written anew at each answer.
pub(super) struct PrometheusFile {
    path: PathBuf,
    /// It could not be written, and that was said.
    said: bool,
}

impl PrometheusFile {
    pub(super) fn new(path: &Path) -> Self {
        Self {
            path: path.into(),
            said: false,
        }
    }

    /// Writes it, whole or not at all. A warning is returned the first time that it cannot be written.
    pub(super) fn write(&mut self, snapshot: &Snapshot) -> Option<String> {
        let written = whole_file::write(&self.path, render(snapshot).as_bytes());
        let failed = written.err()?;
        (!std::mem::replace(&mut self.said, true))
            .then(|| format!("{} cannot be written: {failed}", self.path.display()))
    }
}

/// The text, with labels on each line that tell one run from another of the same machine.
pub(crate) fn render(snapshot: &Snapshot) -> String {
    let endpoints: Vec<_> = snapshot.servers.iter().map(|it| &*it.endpoint).collect();
    let mut page = Page {
        text: String::new(),
        labels: format!(
            "world=\"{}\",agent=\"{}\",seed=\"{}\",endpoint=\"{}\"",
            escaped(&snapshot.world),
            escaped(&snapshot.agent),
            snapshot.seed,
            escaped(&endpoints.join(" "))
        ),
    };
    let up = snapshot.servers.iter().all(|it| it.replay.is_some());
    page.gauge(
        "up",
        "Whether all replay servers of the run answered.",
        Some(u8::from(up)),
    );
    // What only a part of them counts is not the run's.
    if up {
        page.counts(snapshot);
        page.parts(snapshot);
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

    /// A number that may fall; none is left out.
    fn gauge(&mut self, name: &str, help: &str, value: Option<impl Display>) {
        if let Some(value) = value {
            self.head(name, "gauge", help);
            self.sample(name, "", value);
        }
    }

    /// A number that only rises, until the run is started anew.
    fn counter(&mut self, name: &str, help: &str, value: impl Display) {
        self.head(name, "counter", help);
        self.sample(name, "", value);
    }

    fn counts(&mut self, snapshot: &Snapshot) {
        let (numbers, replay) = (&snapshot.numbers, &snapshot.replay);
        self.counter("frames_total", "Transitions stored.", numbers.frames);
        if let Some(updates) = numbers.updates {
            self.counter("updates_total", "Updates of the learner.", updates);
        }
        self.counter("episodes_total", "Episodes that ended.", numbers.episodes);
        for (name, help, count) in [
            (
                "transitions_lost_total",
                "Transitions that never arrived.",
                numbers.transitions_lost,
            ),
            (
                "transitions_duplicated_total",
                "Transitions stored twice.",
                numbers.transitions_duplicated,
            ),
            (
                "messages_refused_total",
                "Messages refused.",
                numbers.messages_refused,
            ),
        ] {
            self.counter(name, help, count);
        }
        for (name, help, seconds) in [
            (
                "learner_waited_seconds_total",
                "Time that requests for a batch waited at the rate limiter.",
                replay.learner_waited_s,
            ),
            (
                "actors_waited_seconds_total",
                "Time that chunks waited at the rate limiter, summed over actors.",
                replay.actors_waited_s,
            ),
        ] {
            self.counter(name, help, seconds);
        }
        self.gauge(
            "frames_planned",
            "Frames of the whole run.",
            Some(snapshot.frames_planned),
        );
        self.gauge(
            "updates_planned",
            "Updates of the whole run.",
            Some(snapshot.updates_planned),
        );
        self.gauge("actors", "Actors that are connected.", Some(numbers.actors));
        self.gauge(
            "weights_version",
            "Version of the newest weights.",
            numbers.weights_version,
        );
        self.gauge(
            "affinity_version",
            "Version of the affinity in use.",
            Some(numbers.affinity_version),
        );
        self.gauge(
            "mean_return_episodes",
            "Episodes in driml_mean_return.",
            Some(numbers.mean_return_of),
        );
        for (name, help, value) in [
            (
                "frames_per_second",
                "Frames a second, over the last while.",
                Some(numbers.frames_per_second),
            ),
            (
                "updates_per_second",
                "Updates a second, over the last while.",
                Some(numbers.updates_per_second),
            ),
            (
                "replay_ratio",
                "Rows sampled per transition since the warm-up.",
                numbers.replay_ratio,
            ),
            (
                "mean_return",
                "Mean undiscounted return of the newest training episodes.",
                numbers.mean_return,
            ),
            (
                "grad_norm",
                "Norm of the last gradient before clipping.",
                numbers.grad_norm,
            ),
            (
                "q_mean",
                "Mean Q value of the states of the last update.",
                numbers.q_mean,
            ),
            ("mean_k", "Mean k of the rows served.", numbers.mean_k),
            ("sd_k", "Standard deviation of k.", numbers.sd_k),
            (
                "mean_age",
                "Mean age of the rows served last, in transitions.",
                Some(numbers.mean_age),
            ),
        ] {
            self.gauge(name, help, value);
        }
        let all = [
            ("c51_kl", numbers.c51_kl),
            ("total_loss", numbers.total_loss),
        ];
        let first = all
            .into_iter()
            .filter_map(|(name, loss)| Some((name, loss?)));
        let others = numbers.losses.iter().map(|(name, loss)| (&**name, *loss));
        let losses: Vec<_> = first.chain(others).collect();
        if !losses.is_empty() {
            self.head(
                "loss",
                "gauge",
                "Losses of the last update, by their columns in metrics.csv.",
            );
        }
        for (name, loss) in losses {
            self.sample("loss", &format!(",loss=\"{}\"", escaped(name)), loss);
        }
        self.gauge(
            "finished",
            "Whether all is learned and saved.",
            Some(u8::from(numbers.finished)),
        );
        self.gauge(
            "well",
            "Whether nothing is missing for the run to go on.",
            Some(u8::from(snapshot.well)),
        );
    }

    fn parts(&mut self, snapshot: &Snapshot) {
        let accounts = snapshot.servers.iter().filter_map(|it| it.parts.as_ref());
        let parts: Vec<_> = accounts.flat_map(|it| &it.parts).collect();
        // With several shards the learner takes part in each.
        let mut seen = std::collections::BTreeSet::new();
        let parts: Vec<_> = parts.into_iter().filter(|it| seen.insert(it.who)).collect();
        let label = |who| format!(",part=\"{who}\"");
        if parts.is_empty() {
            return;
        }
        self.head(
            "part_connected",
            "gauge",
            "Whether a part that has joined the run is connected.",
        );
        for part in &parts {
            self.sample("part_connected", &label(part.who), u8::from(part.connected));
        }
        self.head(
            "part_joined_total",
            "counter",
            "How often a part has joined the run.",
        );
        for part in &parts {
            self.sample("part_joined_total", &label(part.who), part.lives);
        }
        let heard: Vec<_> = parts
            .iter()
            .filter_map(|it| Some((it.who, it.heard_s?)))
            .collect();
        if !heard.is_empty() {
            let help = "Seconds since the last chunk or request for a batch of a part.";
            self.head("part_silent_seconds", "gauge", help);
        }
        for (who, seconds) in heard {
            self.sample("part_silent_seconds", &label(who), seconds);
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
