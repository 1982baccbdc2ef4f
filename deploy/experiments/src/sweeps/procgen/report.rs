//! Figure and page of table 1, from finished runs.

use std::collections::BTreeMap;

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_launch::evaluate::Levels;
use driml_protocol::RETURNS_OF;

use super::{
    results::{ERRORS, Scored, by_game, of, training},
    settings::{CHECKPOINTS, Settings},
};
use crate::{
    cache::Session,
    page::{Table, Values, cell},
    plot::{Run, over_seeds},
    stats::{
        Spread,
        over_games::{Scores, improvement, iqm},
    },
    sweep::results::mean,
    sweeps::published::Published,
};

/// Frames of the paper's runs.
const PAPER_FRAMES: f64 = 50e6;
/// Seeds of each game and agent from which on scores over all games are made.
const SEEDS_MIN: usize = 3;

/// Training return over frames, a chart a game.
pub(super) fn figure(
    settings: &Settings,
    scored: &[Scored],
    published: &Published,
) -> anyhow::Result<Figure> {
    let mut panels = Vec::new();
    for (game, runs) in by_game(scored) {
        let level = |value: f64| vec![(0.0, value), (settings.frames as f64, value)];
        let mut series = Vec::new();
        if let Some(random) = mean(&runs[0].random) {
            series.push(Series::line("random", 0, level(random)).coloured(GREY));
        }
        for (index, agent) in settings.agents.iter().enumerate() {
            let mut each = Vec::new();
            for it in of(&runs, agent) {
                each.push(Run::read(&it.made.run.folder)?.values("mean_return")?);
            }
            let curve = over_seeds(&each);
            if curve.points.is_empty() {
                continue;
            }
            series.push(Series::line(agent, index, curve.points).banded(curve.band));
            if let Some(paper) = published.paper(game, agent) {
                series.push(Series::line("", index, level(paper)).marked(Mark::Dashed));
            }
        }
        let (x, y) = (Axis::linear("frames"), Axis::linear("mean return"));
        panels.push(Panel::Chart(Chart::new(game, x, y, series)));
    }
    Ok(Figure {
        title: format!("Training return, {} frames", settings.frames),
        notes: vec![format!(
            "Mean of the last {RETURNS_OF} training episodes, with exploration; over several seeds mean and range. Dashed: the paper's \
             after 50 million frames. Grey: a random policy."
        )],
        columns: panels.len().min(4),
        panel_size: (300.0, 230.0),
        panels,
    })
}

/// Scores over all games, where each game and agent has enough seeds for an interval.
pub(super) fn over_games(
    session: &mut Session,
    settings: &Settings,
    scored: &[Scored],
    published: &Published,
) -> anyhow::Result<Vec<String>> {
    let games = by_game(scored);
    let has_seeds = |runs: &Vec<&Scored>| {
        let mut agents = settings.agents.iter();
        agents.all(|agent| of(runs, agent).count() >= SEEDS_MIN)
    };
    if !games.values().all(has_seeds) {
        return Ok(Vec::new());
    }
    let mut lines = Vec::new();
    let play = settings.play(Levels::TrainSingle);
    for agent in &settings.agents {
        let mut scores = Scores::new();
        for (game, runs) in &games {
            let mut of_game = Vec::new();
            for it in of(runs, agent) {
                session.work().1.again(play.units);
                let key = format!("{}-single", it.made.plan.name);
                let returns = play.greedy(session, &key, &it.made.run)?;
                let returns = returns.and_then(|it| mean(&it));
                of_game.extend(returns.and_then(|it| published.normalised(game, it)));
            }
            if of_game.len() >= SEEDS_MIN {
                scores.push(of_game);
            }
        }
        lines.extend(iqm(&scores).map(|it| {
            format!(
                "Interquartile mean of `{agent}` over {} games: {it:.3} (greedy, an episode a level, normalised as by Cobbe et al. 2020).",
                scores.len()
            )
        }));
    }
    if let Some((first, others)) = settings.agents.split_first() {
        for agent in others {
            let scores = |agent: &str| -> Scores {
                games
                    .values()
                    .map(|runs| training(of(runs, agent)))
                    .collect()
            };
            lines.extend(improvement(&scores(agent), &scores(first)).map(|it| {
                format!("Probability that `{agent}` trains better than `{first}`: {it:.3}.")
            }));
        }
    }
    Ok(lines)
}

/// What the page says.
pub(super) fn page(
    settings: &Settings,
    scored: &[Scored],
    published: &Published,
    over_games: Vec<String>,
    missing: &[String],
) -> Values {
    let games = by_game(scored);
    let has_seeds = scored.iter().any(|it| it.made.plan.call.seed > 1);
    let mut values = Values::default();
    values
        .set("count", scored.len())
        .set("planned", scored.len() + missing.len())
        .set("frames", settings.frames)
        .set("percent", percent(settings.frames as f64 / PAPER_FRAMES))
        .items("above_random", above_random(settings, &games))
        .items("over_games", over_games)
        .when("some_missing", !missing.is_empty())
        .set("missing", missing.join(", "))
        .set("table", table(settings, &games, published))
        .set("returns_of", RETURNS_OF)
        .set("episodes", CHECKPOINTS * settings.episodes)
        .when("some_seeds", has_seeds)
        .set("seeds", settings.seeds)
        .set("preset", &settings.preset)
        .when("has_sets", !settings.sets.is_empty())
        .set("sets", settings.sets.join(", "))
        .when("sequential", settings.preset != "split");
    values
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    let decimals = (1.0 - percent.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{percent:.decimals$}")
}

/// A game a row; of each agent ours and the paper's.
fn table(
    settings: &Settings,
    games: &BTreeMap<&str, Vec<&Scored>>,
    published: &Published,
) -> Table {
    let mut header = vec!["game".to_owned(), "random".into()];
    for agent in &settings.agents {
        let columns = ["training", "greedy", "paper"];
        header.extend(columns.map(|column| format!("{agent} {column}")));
    }
    let short_number = |value: Option<f64>| cell(value, |it| format!("{it:.2}"));
    let spread = |values: Vec<f64>| {
        cell(Spread::of(values), |it| match it.count {
            1 => format!("{:.2}", it.mean),
            _ => format!("{:.2} ± {:.2}", it.mean, it.sd),
        })
    };
    let rows = games.iter().map(|(game, runs)| {
        let mut row = vec![(*game).to_owned(), short_number(mean(&runs[0].random))];
        for agent in &settings.agents {
            row.push(spread(training(of(runs, agent))));
            let greedy = of(runs, agent).filter_map(|it| mean(&it.greedy));
            row.push(spread(greedy.collect()));
            row.push(short_number(published.paper(game, agent)));
        }
        row
    });
    Table {
        rows: rows.collect(),
        header,
    }
}

/// On how many of its games each agent plays better than at random.
fn above_random(settings: &Settings, games: &BTreeMap<&str, Vec<&Scored>>) -> Vec<String> {
    let line = |agent: &String| {
        let played = games
            .iter()
            .filter(|(_, runs)| of(runs, agent).next().is_some());
        let count = played.clone().count();
        let above = played.filter(|(_, runs)| of(runs, agent).all(Scored::is_above_random));
        let text = format!(
            "`{agent}` is better than random, in every seed by {ERRORS} standard errors, on {} of {count} games.",
            above.count()
        );
        (count > 0).then_some(text)
    };
    settings.agents.iter().filter_map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_shares_keep_two_digits() {
        assert_eq!(
            [0.002, 0.000012, 0.5, 1.0].map(percent),
            ["0.20", "0.0012", "50", "100"]
        );
    }
}
