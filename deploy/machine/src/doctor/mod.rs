//! `driml doctor`: what this machine can do and what it lacks, one line a fact, with what to do about it.
//! It changes nothing, fetches nothing and measures no speed.

mod certificates;
pub(crate) mod cuda;
mod engine;
mod fact;
mod host;

use std::path::Path;

use anyhow::ensure;

use self::fact::{Fact, State};

/// What was found out, for the CPU and for CUDA.
#[derive(Debug)]
pub struct Report {
    cpu: Vec<Fact>,
    cuda: Vec<Fact>,
    certificates: Vec<Fact>,
}

/// Looks at this machine; runs would go to `run_dir`, with the certificates in `tls_dir`, if any.
pub fn examine(run_dir: &Path, tls_dir: Option<&Path>) -> Report {
    let mut cpu = host::facts(run_dir);
    cpu.push(engine::fact());
    let cuda = cuda::facts();
    let certificates = tls_dir.map_or_else(Vec::new, certificates::facts);
    Report {
        cpu,
        cuda,
        certificates,
    }
}

impl Report {
    /// A line a fact, and what can be trained on.
    pub fn describe(&self) -> String {
        describe(&self.all(), verdict(&self.cpu, &self.cuda))
    }

    /// The facts as JSON.
    pub fn json(&self) -> anyhow::Result<String> {
        Ok(serde_json::to_string_pretty(&self.all())? + "\n")
    }

    fn all(&self) -> Vec<Fact> {
        let all = self.cpu.iter().chain(&self.cuda);
        all.chain(&self.certificates).cloned().collect()
    }

    /// Fails where something is missing that training on the CPU needs, or a certificate is not good; with `cuda`, also what training
    /// on a GPU needs.
    pub fn check(&self, cuda: bool) -> anyhow::Result<()> {
        let is_missing = |state| state == State::Missing;
        let missing = lacking(&self.cpu, is_missing);
        ensure!(missing.is_empty(), "training on the CPU needs: {missing}");
        let bad = lacking(&self.certificates, is_missing);
        ensure!(bad.is_empty(), "these certificates cannot be used: {bad}");
        let missing = lacking(&self.cuda, |state| state != State::Ok);
        ensure!(
            !cuda || cuda::is_ready(&self.cuda),
            "--device cuda needs: {missing}"
        );
        Ok(())
    }
}

/// The facts whose state is bad, by name.
fn lacking(facts: &[Fact], bad: impl Fn(State) -> bool) -> String {
    let bad = facts.iter().filter(|fact| bad(fact.state));
    let names: Vec<_> = bad.map(|fact| fact.what.as_str()).collect();
    names.join(", ")
}

fn describe(facts: &[Fact], verdict: &str) -> String {
    let lines = facts.iter().map(|fact| format!("{fact}\n"));
    format!("{}\n{verdict}\n", lines.collect::<String>())
}

fn verdict(cpu: &[Fact], cuda: &[Fact]) -> &'static str {
    let cpu = cpu.iter().all(|fact| fact.state != State::Missing);
    let cuda = cuda::is_ready(cuda);
    match (cpu, cuda) {
        (true, true) => "This machine can train on the CPU and with --device cuda.",
        (true, false) => "This machine can train on the CPU, not with --device cuda.",
        (false, _) => "This machine cannot train yet.",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_verdict_follows_what_is_missing() {
        let cpu = |state| vec![Fact::ok("cores", ""), Fact::new(state, "disk", "")];
        let cuda = |state| {
            vec![
                Fact::missing("cuda:0", "not for this one"),
                Fact::new(state, "cuda:1", ""),
            ]
        };
        let says = |state, device| verdict(&cpu(state), &cuda(device));
        assert!(says(State::Note, State::Ok).contains("CPU and with"));
        assert!(says(State::Ok, State::Missing).contains("not with"));
        assert!(verdict(&cpu(State::Ok), &[Fact::note("cuda", "none")]).contains("not with"));
        assert!(says(State::Missing, State::Ok).contains("cannot"));
    }

    #[test]
    fn every_fact_is_a_line_and_the_verdict_stands_apart() {
        let broken = Fact::missing("Procgen", "not there:\n  do this");
        let facts = [Fact::ok("cores", "2"), broken.clone()];
        let text = describe(&facts, "Done.");
        let lines = "ok       cores             2\nmissing  Procgen           not there: do this\n\nDone.\n";
        assert_eq!(text, lines);
        let json = serde_json::to_string(&broken).unwrap();
        assert!(json.contains(r#""state":"missing""#), "{json}");
    }
}
