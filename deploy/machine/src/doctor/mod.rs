//! `driml doctor`: what this machine can do and what it lacks. Each fact is one line with what to do about it.
//! The doctor changes nothing, fetches nothing and measures no speed.

mod certificates;
mod fact;
mod host;

use std::path::Path;

use anyhow::ensure;

use self::fact::{Fact, State};
use crate::device;

/// The facts about this machine: for training on the CPU, for CUDA, and about the certificates.
#[derive(Debug)]
pub struct Report {
    cpu: Vec<Fact>,
    cuda: Vec<Fact>,
    certificates: Vec<Fact>,
}

/// Examines this machine. `run_dir` is where runs would be written; `tls_dir` holds the certificates, if any.
pub fn examine(run_dir: &Path, tls_dir: Option<&Path>) -> Report {
    // Training on the CPU needs no GPU.
    let gpu_fact = |ordinal| {
        let found = device::describe_gpu(ordinal);
        let found = found.map_or_else(|why| State::Missing.with(why), |it| State::Ok.with(it));
        Fact::new(format!("cuda:{ordinal}"), found)
    };
    let cuda = match device::gpu_count() {
        Ok(count) => (0..count).map(gpu_fact).collect(),
        Err(why) => vec![Fact::new("cuda", State::Note.with(why))],
    };
    Report {
        cpu: host::facts(run_dir),
        cuda,
        certificates: tls_dir.map_or_else(Vec::new, certificates::facts),
    }
}

impl Report {
    /// One line per fact, and a last line that says which devices this machine can train on.
    pub fn describe(&self) -> String {
        let lines: String = self.facts().map(|fact| format!("{fact}\n")).collect();
        let is_cpu_ready = self.cpu.iter().all(|fact| fact.state != State::Missing);
        let verdict = match (is_cpu_ready, self.is_ready_for_cuda()) {
            (true, true) => "This machine can train on the CPU and with --device cuda.",
            (true, false) => "This machine can train on the CPU, not with --device cuda.",
            (false, _) => "This machine cannot train yet.",
        };
        format!("{lines}\n{verdict}\n")
    }

    /// The facts as JSON.
    pub fn json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string_pretty(&self.facts().collect::<Vec<_>>())? + "\n")
    }

    fn facts(&self) -> impl Iterator<Item = &Fact> {
        self.cpu.iter().chain(&self.cuda).chain(&self.certificates)
    }

    fn is_ready_for_cuda(&self) -> bool {
        self.cuda.iter().any(|fact| fact.state == State::Ok)
    }

    /// Fails if something is missing that training on the CPU needs, or if a certificate is not valid. With `cuda`, also fails if
    /// something is missing that training on a GPU needs.
    pub fn check(&self, cuda: bool) -> anyhow::Result<()> {
        let is_missing = |state| state == State::Missing;
        let missing = names_where(&self.cpu, is_missing);
        ensure!(missing.is_empty(), "training on the CPU needs: {missing}");
        let bad = names_where(&self.certificates, is_missing);
        ensure!(bad.is_empty(), "these certificates cannot be used: {bad}");
        let missing = names_where(&self.cuda, |state| state != State::Ok);
        ensure!(
            !cuda || self.is_ready_for_cuda(),
            "--device cuda cannot work without: {missing}"
        );
        Ok(())
    }
}

fn names_where(facts: &[Fact], is_bad: impl Fn(State) -> bool) -> String {
    let bad = facts.iter().filter(|fact| is_bad(fact.state));
    let names: Vec<_> = bad.map(|fact| fact.what.as_str()).collect();
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_gpu_is_not_missed_where_the_program_is_built_without() {
        let report = examine(Path::new("."), None);
        assert_eq!(report.cuda[0].state, State::Note);
        assert!(!report.is_ready_for_cuda());
    }

    #[test]
    fn every_fact_is_a_line_and_the_verdict_follows_what_is_missing() {
        let fact = |what: &str, state: State, text: &str| Fact::new(what, state.with(text));
        for (disk, cuda, verdict) in [
            (State::Note, State::Ok, "can train on the CPU and with"),
            (State::Ok, State::Missing, "can train on the CPU, not with"),
            (State::Ok, State::Note, "can train on the CPU, not with"),
            (State::Missing, State::Ok, "cannot train yet"),
        ] {
            let text = "not there:\n  do this";
            let verdict = format!("\n\nThis machine {verdict}");
            let report = Report {
                cpu: vec![fact("cores", State::Ok, "2"), fact("disk", disk, "")],
                cuda: vec![fact("cuda:0", State::Missing, text), fact("1", cuda, "")],
                certificates: Vec::new(),
            };
            let text = report.describe();
            let lines = [
                "ok       cores             2\n",
                "missing  cuda:0            not there: do this\n",
                &*verdict,
            ];
            assert!(lines.iter().all(|it| text.contains(it)), "{text}");
            let json = report.json().unwrap();
            assert!(json.contains(r#""state": "missing""#), "{json}");
        }
    }
}
