//! `driml inspect`: what a configuration builds, holds, sends and computes, and the same with everything on.
//! All numbers follow from the settings: this module builds no network, plays no world and measures no time.

mod count;

use anyhow::Context;
use driml_settings::config::RunConfig;
use indicatif::HumanCount;
use serde::Serialize;

use crate::console::align_columns;
use count::{CostCounter, EVERYTHING, Line, units};

/// The size and the cost of a world and an agent.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Inspection {
    pub(crate) world: String,
    pub(crate) agent: String,
    /// The meaning of [`Line::everything`].
    pub(crate) everything: &'static str,
    /// Scalars of all networks that the learner holds, layer by layer.
    pub(crate) parameters: Vec<Line>,
    /// Multiplications and additions of one update, part by part. Rows that need less are not known before a batch is drawn.
    pub(crate) update_flops: Vec<Line>,
    /// Multiplications and additions of one decision of an actor, layer by layer.
    pub(crate) decision_flops: Vec<Line>,
    /// Bytes of what is sent and of what is kept, without headers of some 60 bytes. The lines overlap and have no sum.
    pub(crate) bytes: Vec<Line>,
}

impl Inspection {
    /// Counts for the settings of a run.
    pub fn new(config: &RunConfig) -> anyhow::Result<Self> {
        let counters = CostCounter::new(config)
            .and_then(|is| Ok([is, CostCounter::with_everything_on(config)?]))
            .context("computing the size of the weights")?;
        let units = units(&counters[1].model);
        let lines = |count: &dyn Fn(&CostCounter<'_>) -> Vec<(String, u64)>| -> Vec<Line> {
            let [is, all] = counters.each_ref().map(count);
            let line = |((what, is), (_, everything))| Line {
                what,
                is,
                everything,
            };
            is.into_iter().zip(all).map(line).collect()
        };
        Ok(Self {
            world: config.run.world.clone(),
            agent: config.run.agent.clone(),
            everything: EVERYTHING,
            parameters: lines(&|it| it.parameters(&units)),
            update_flops: lines(&|it| it.update_flops()),
            decision_flops: lines(&|it| it.decision_flops()),
            bytes: lines(&|it| it.bytes()),
        })
    }

    /// The table for a terminal.
    pub fn describe(&self) -> String {
        let mut rows: Vec<Vec<String>> = Vec::new();
        for (heading, lines, is_summed) in [
            ("parameters", &self.parameters, true),
            ("FLOPs per update", &self.update_flops, true),
            ("FLOPs per decision", &self.decision_flops, true),
            ("bytes held and sent", &self.bytes, false),
        ] {
            let heads = [heading, "is", "everything"].map(String::from);
            rows.extend([Vec::new(), heads.into()]);
            let sum = is_summed.then(|| sum_line("all", lines));
            for line in lines.iter().chain(&sum) {
                let [is, all] = [line.is, line.everything].map(|n| HumanCount(n).to_string());
                rows.push(vec![line.what.clone(), is, all]);
            }
        }
        let (agent, world, everything) = (&self.agent, &self.world, self.everything);
        let table = align_columns(&rows, &[1, 2]);
        format!("{agent} on {world}\n{table}\neverything: {everything}\n")
    }
}

/// A table with one line per world: the sums of an agent's tables.
pub fn describe_worlds(inspections: &[Inspection]) -> String {
    let headings = "world,parameters,FLOPs/update,FLOPs/decision,bytes/batch";
    let mut rows = vec![headings.split(',').map(String::from).collect()];
    for it in inspections {
        let batch = it.bytes.iter().find(|it| it.what == count::BATCH_NAME);
        let batch = batch.map_or(&[][..], std::slice::from_ref);
        let counts = [
            &it.parameters[..],
            &it.update_flops,
            &it.decision_flops,
            batch,
        ];
        let sums = counts.map(|lines| HumanCount(sum_line("", lines).is).to_string());
        rows.push([vec![it.world.clone()], sums.into()].concat());
    }
    align_columns(&rows, &[1, 2, 3, 4])
}

fn sum_line(what: &str, lines: &[Line]) -> Line {
    Line {
        what: what.to_owned(),
        is: lines.iter().map(|line| line.is).sum(),
        everything: lines.iter().map(|line| line.everything).sum(),
    }
}

#[cfg(test)]
mod tests;
