//! Scores over all games, normalised or by rank, with their intervals. The arithmetic is in `aggregate`.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};

use super::{
    published,
    results::{Kind, Results},
};
use crate::{
    aggregate::{self, Scores},
    statistics::Interval,
};

/// Scores over all games.
pub(super) struct Aggregate {
    pub(super) measure: &'static str,
    pub(super) kind: Kind,
    pub(super) agent: String,
    pub(super) games: usize,
    pub(super) interval: Interval,
}

/// The agent that the others are compared with.
pub(super) fn baseline(results: &Results) -> Option<&str> {
    let agents = results.agents();
    let c51 = agents.iter().find(|agent| **agent == "c51").copied();
    c51.or(agents.first().copied())
}

/// Interquartile means of normalised scores, and probabilities of improvement over the baseline; over the games in which
/// all that is compared has scores.
pub(super) fn of(results: &Results) -> Vec<Aggregate> {
    let mut all = Vec::new();
    let baseline = baseline(results).unwrap_or_default();
    for kind in [Kind::Single, Kind::Unseen] {
        let mut common = results.worlds();
        common.retain(|world| {
            let known = |agent: &&str| !results.means(world, agent, kind).is_empty();
            published::normalised(world, 0.0).is_some() && results.agents().iter().all(known)
        });
        for agent in results.agents() {
            let scores: Scores = common
                .iter()
                .map(|world| {
                    let means = results.means(world, agent, kind).into_iter();
                    means
                        .filter_map(|mean| published::normalised(world, mean))
                        .collect()
                })
                .collect();
            all.extend(aggregate::iqm(&scores).map(|interval| Aggregate {
                measure: "interquartile mean",
                kind,
                agent: agent.to_owned(),
                games: scores.len(),
                interval,
            }));
        }
    }
    for kind in [Kind::Training, Kind::Unseen] {
        for agent in results
            .agents()
            .into_iter()
            .filter(|agent| *agent != baseline)
        {
            let pairs = results.worlds().into_iter().map(|world| {
                let of = |agent: &str| results.means(world, agent, kind);
                (of(agent), of(baseline))
            });
            let both = pairs.filter(|(x, y)| !x.is_empty() && !y.is_empty());
            let (x, y): (Scores, Scores) = both.unzip();
            all.extend(aggregate::improvement(&x, &y).map(|interval| Aggregate {
                measure: "probability of improvement",
                kind,
                agent: agent.to_owned(),
                games: x.len(),
                interval,
            }));
        }
    }
    all
}

/// Interquartile means and probabilities of improvement with their intervals.
pub(super) fn figure(results: &Results, aggregates: &[Aggregate]) -> Figure {
    let baseline = baseline(results).unwrap_or_default();
    let panel = |title: &str, measure: &str, label: &str, kinds: [Kind; 2], level: Option<f64>| {
        let of = |agent: &&&str| {
            aggregates
                .iter()
                .any(|it| it.measure == measure && it.agent == ***agent)
        };
        let agents: Vec<String> = results
            .agents()
            .iter()
            .filter(of)
            .map(|it| (*it).to_owned())
            .collect();
        let mut series = Vec::new();
        if let Some(level) = level {
            let ends = vec![(-0.5, level), (agents.len() as f64 - 0.5, level)];
            series.push(
                Series::line("no difference", 0, ends)
                    .coloured(GREY)
                    .marked(Mark::Dashed),
            );
        }
        let has = |kind: Kind| move |it: &&Aggregate| it.measure == measure && it.kind == kind;
        let both = kinds
            .iter()
            .all(|&kind| aggregates.iter().any(|it| has(kind)(&it)));
        for (index, kind) in kinds.into_iter().enumerate() {
            let (mut points, mut band) = (Vec::new(), Vec::new());
            for it in aggregates
                .iter()
                .filter(|it| it.measure == measure && it.kind == kind)
            {
                let place = agents
                    .iter()
                    .position(|agent| *agent == it.agent)
                    .unwrap_or(0);
                // Two kinds stand side by side.
                let aside = if both {
                    0.16 * (index as f64 - 0.5)
                } else {
                    0.0
                };
                let x = place as f64 + aside;
                points.push((x, it.interval.mean));
                band.extend(it.interval.ends.map(|(low, high)| (x, low, high)));
            }
            if !points.is_empty() {
                series.push(
                    Series::line(kind.name(), index, points)
                        .banded(band)
                        .marked(Mark::Bars),
                );
            }
        }
        Panel::Chart(Chart::new(
            title,
            Axis::names("agent", &agents),
            Axis::linear(label),
            series,
        ))
    };
    let measured = |measure: &str| aggregates.iter().any(|it| it.measure == measure);
    let panels = [
        panel(
            "Interquartile mean of normalised scores",
            "interquartile mean",
            "normalised return",
            [Kind::Single, Kind::Unseen],
            None,
        ),
        panel(
            &format!("Probability that an agent is better than {baseline}"),
            "probability of improvement",
            "probability",
            [Kind::Training, Kind::Unseen],
            Some(0.5),
        ),
    ];
    let panels = panels
        .into_iter()
        .zip(["interquartile mean", "probability of improvement"]);
    Figure {
        title: "Over all games".into(),
        notes: vec![
            "Bars: 95% intervals over seeds (jackknife, Student's t). Normalised: 0 and 1 are the published minimum and maximum \
             of each game in mode easy (Cobbe et al. 2020, appendix C), an episode a level."
                .into(),
        ],
        columns: 2,
        panel_size: (430.0, 320.0),
        panels: panels.filter(|(_, measure)| measured(measure)).map(|(panel, _)| panel).collect(),
    }
}
