//! Figure and page of table 1, from finished runs.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_launch::evaluate::Levels;
use driml_protocol::RETURNS_OF;

use super::{
    results::{ERRORS, Game},
    settings::{CHECKPOINTS, Settings},
};
use crate::{
    cache::Session,
    page::Values,
    plot::{Run, over_seeds},
    stats::over_games::{Scores, improvement, iqm},
    sweep::results::mean,
    sweeps::published::Published,
};

/// Frames of the paper's runs.
const PAPER_FRAMES: f64 = 50e6;
/// Seeds of each game and agent from which on scores over all games are made.
const SEEDS_MIN: usize = 3;

/// Training return over frames, a chart a game.
pub(super) fn figure(settings: &Settings, games: &[Game<'_>]) -> anyhow::Result<Figure> {
    let mut panels = Vec::new();
    for game in games {
        let level = |value: f64| vec![(0.0, value), (settings.frames as f64, value)];
        let mut series = Vec::new();
        if let Some(random) = mean(game.random) {
            series.push(Series::line("random", 0, level(random)).coloured(GREY));
        }
        for (index, (agent, of)) in settings.agents.iter().zip(&game.agents).enumerate() {
            let each = of.runs.iter();
            let each = each.map(|it| Ok(Run::read(&it.made.run.folder)?.values("mean_return")?));
            let curve = over_seeds(&each.collect::<anyhow::Result<Vec<_>>>()?);
            if curve.points.is_empty() {
                continue;
            }
            series.push(curve.series(agent, index));
            if let Some(paper) = of.paper {
                series.push(Series::line("", index, level(paper)).marked(Mark::Dashed));
            }
        }
        let (x, y) = (Axis::linear("frames"), Axis::linear("mean return"));
        panels.push(Panel::Chart(Chart::new(game.name, x, y, series)));
    }
    Ok(Figure {
        title: "Training return by game".into(),
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
    games: &[Game<'_>],
    published: &Published,
) -> anyhow::Result<Vec<String>> {
    let mut all = games.iter().flat_map(|it| &it.agents);
    if !all.all(|of| of.runs.len() >= SEEDS_MIN) {
        return Ok(Vec::new());
    }
    let mut lines = Vec::new();
    let play = settings.play(Levels::TrainSingle);
    for (at, agent) in settings.agents.iter().enumerate() {
        let mut scores = Scores::new();
        for game in games {
            let mut of_game = Vec::new();
            for it in &game.agents[at].runs {
                session.work().1.again(play.units);
                let key = format!("{}-single", it.made.plan.name);
                let returns = play.greedy(session, &key, &it.made.run)?;
                let returns = returns.and_then(|it| mean(&it));
                of_game.extend(returns.and_then(|it| published.normalised(game.name, it)));
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
    let scores = |at: usize| -> Scores {
        let trained = games.iter().map(|game| game.agents[at].training.clone());
        trained.collect()
    };
    for (at, agent) in settings.agents.iter().enumerate().skip(1) {
        let first = &settings.agents[0];
        lines.extend(improvement(&scores(at), &scores(0)).map(|it| {
            format!("Probability that `{agent}` trains better than `{first}`: {it:.3}.")
        }));
    }
    Ok(lines)
}

/// What the page says.
pub(super) fn page(settings: &Settings, games: &[Game<'_>], missing: &[String]) -> Values {
    let runs = games
        .iter()
        .flat_map(|it| &it.agents)
        .flat_map(|it| &it.runs);
    let has_seeds = runs.clone().any(|it| it.made.plan.call.seed > 1);
    let mut values = Values::default();
    values
        .set("settings", settings)
        .set("agents", &settings.agents)
        .set("seeds", settings.seeds)
        .set("games", games)
        .set("percent", percent(settings.frames as f64 / PAPER_FRAMES))
        .set("above_random", above_random(settings, games))
        .set("missing", missing)
        .set("returns_of", RETURNS_OF)
        .set("episodes", CHECKPOINTS * settings.episodes)
        .set("some_seeds", has_seeds);
    values
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    let decimals = (1.0 - percent.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{percent:.decimals$}")
}

/// On how many of its games each agent plays better than at random.
fn above_random(settings: &Settings, games: &[Game<'_>]) -> Vec<String> {
    let agents = settings.agents.iter().enumerate();
    let lines = agents.filter_map(|(at, agent)| {
        let of_game = games.iter().map(|game| &game.agents[at]);
        let played: Vec<_> = of_game.filter(|of| !of.runs.is_empty()).collect();
        let above = played.iter().filter(|of| of.is_above_random);
        let text = format!(
            "`{agent}` is better than random, in every seed by {ERRORS} standard errors, on {} of {} games.",
            above.count(),
            played.len()
        );
        (!played.is_empty()).then_some(text)
    });
    lines.collect()
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
