//! The page of table 1: what came out beside the paper, and what the length of the runs can tell.
//! Every number is made here from the runs.

use driml_envs::WorldName;
use driml_launch::run_folder::Summary;
use driml_protocol::RETURNS_OF;

use super::{
    grid::short,
    k, published,
    results::{Kind, Results, RunResult},
    scores::{Aggregate, baseline},
};
use crate::{
    aggregate,
    page::{Page, Table},
    statistics::Spread,
    template::Values,
};

const TEMPLATE: &str = include_str!("page.md");
/// Frames of the paper's runs.
const PAPER_FRAMES: f64 = 50e6;
/// Standard errors from which on a mean return counts as different from the random policy's.
const ERRORS: f64 = 2.0;

/// The page of table 1: what the runs gave beside the paper's numbers.
pub(super) fn page(results: &Results, aggregates: &[Aggregate], adaptive: bool) -> Page {
    let settings = &results.settings;
    let norm_scores = norm_scores(results);
    let mut values = Values::default();
    values
        .items("above_random", above_random(results))
        .when("some_missing", !results.missing.is_empty())
        .set("missing", results.missing.join(", "))
        .when("has_scores", !aggregates.is_empty())
        .set("baseline", baseline(results).unwrap_or_default())
        .when("has_norm_score", norm_scores.is_some())
        .when("adaptive", adaptive);
    let scores = (!aggregates.is_empty()).then(|| scores(results, aggregates));
    values
        .set("scores", scores.unwrap_or_default())
        .set("table_1", table_1(results, norm_scores))
        .set("greedy", greedy(results))
        .set(
            "actions",
            if adaptive {
                actions(results).to_string()
            } else {
                String::new()
            },
        );
    let share = settings.frames as f64 / PAPER_FRAMES;
    let worlds = results.worlds();
    let games = worlds.iter().filter(|world| world.starts_with("procgen:"));
    let games = games.count();
    values
        .set("percent", percent(share))
        .when("sequential", settings.preset != "split")
        .set("games", games)
        .when("no_games", games == 0)
        .when("some_games", (1..16).contains(&games));
    let summaries = results.cells.iter().map(|cell| &cell.ran.summary);
    resumed(&summaries.collect::<Vec<_>>(), &mut values);
    values
        .set("preset", &settings.preset)
        .when("has_sets", !settings.sets.is_empty())
        .set("sets", settings.sets.join(", "))
        .set("frames", settings.frames)
        .set("seeds", settings.seeds)
        .set("episodes", settings.episodes);
    Page::new(TEMPLATE, values, &results.command, results.smoke)
}

/// Which runs were interrupted and went on, and of which of these only the returns since then are known.
fn resumed(all: &[&Summary], values: &mut Values) {
    let resumed = all.iter().filter(|it| it.resumed_after_updates > 0);
    let count = resumed.clone().count();
    // What an older version played before the interruption was not kept.
    let short = resumed.filter(|it| it.mean_return_of < it.episodes.min(RETURNS_OF as u64));
    let short = short.count();
    values
        .when("some_resumed", count > 0)
        .set("resumed", count)
        .set("runs", all.len())
        .when("some_short", short > 0)
        .set("short", short)
        .set("returns_of", RETURNS_OF);
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    let decimals = (1.0 - percent.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{percent:.decimals$}")
}

/// On how many games each agent plays better than at random.
fn above_random(results: &Results) -> Vec<String> {
    let line = |agent: &str| {
        let played = || {
            results
                .worlds()
                .into_iter()
                .filter(|world| results.of(world, agent).next().is_some())
        };
        let above: Vec<&str> = played()
            .filter(|world| is_above_random(results, world, agent))
            .map(short)
            .collect();
        let which = if above.is_empty() {
            String::new()
        } else {
            format!(": {}", above.join(", "))
        };
        format!(
            "`{agent}` plays better than at random, in every seed by {ERRORS} standard errors of its episodes as trained, on {} of {} \
             games{which}.",
            above.len(),
            played().count()
        )
    };
    results.agents().into_iter().map(line).collect()
}

/// Scores over all games: an agent a row, a measure a column.
fn scores(results: &Results, aggregates: &[Aggregate]) -> Table {
    let mut measures: Vec<(&str, Kind)> = Vec::new();
    for it in aggregates {
        if !measures.contains(&(it.measure, it.kind)) {
            measures.push((it.measure, it.kind));
        }
    }
    let head = measures
        .iter()
        .map(|(measure, kind)| format!("{measure}, {}", kind.name()));
    let row = |agent: &str| {
        let cells = measures.iter().map(|&(measure, kind)| {
            let mut here = aggregates
                .iter()
                .filter(|it| it.measure == measure && it.kind == kind);
            let found = here.find(|it| it.agent == agent);
            found.map_or("-".into(), |it| {
                format!("{:.3} ({})", it.interval, it.games)
            })
        });
        [format!("`{agent}`")].into_iter().chain(cells).collect()
    };
    Table {
        header: ["agent".to_owned()].into_iter().chain(head).collect(),
        rows: results.agents().into_iter().map(row).collect(),
    }
}

/// Whether the episodes of each of the agent's seeds are better than the random policy's.
fn is_above_random(results: &Results, world: &str, agent: &str) -> bool {
    let random = Spread::of(results.random[world].trained.iter().copied());
    results.of(world, agent).all(|cell| {
        let played = Spread::of(cell.played.trained.iter().copied());
        match (&played, &random) {
            (Some(agent), Some(random)) => {
                let error = |it: &Spread| it.sd.powi(2) / it.count as f64;
                agent.mean - random.mean > ERRORS * (error(agent) + error(random)).sqrt()
            }
            _ => false,
        }
    })
}

/// Ours beside the paper's.
fn table_1(results: &Results, norm_scores: Option<Vec<String>>) -> Table {
    let agents = results.agents();
    let mut rows: Vec<Vec<String>> = Vec::new();
    for world in results.worlds() {
        let cells = agents.iter().map(|agent| {
            let ours = Spread::of(results.means(world, agent, Kind::Training));
            let ours = ours.map_or("-".into(), |it| plus_minus(it.mean, it.sd, it.count));
            match published::paper(world, agent) {
                Some((mean, sd)) => format!("{ours} (paper {mean:.2} ± {sd:.2})"),
                None => ours,
            }
        });
        let random = results.random[world].mean(Kind::Trained);
        let random = random.map_or("-".into(), |mean| format!("{mean:.2}"));
        rows.push(
            [short(world).to_owned(), random]
                .into_iter()
                .chain(cells)
                .collect(),
        );
    }
    rows.extend(norm_scores);
    Table {
        header: ["game", "random"]
            .iter()
            .chain(&agents)
            .map(|it| (*it).to_owned())
            .collect(),
        rows,
    }
}

/// The paper's last row of table 1, ours and by its numbers; none if an agent lacks a game or the score is not defined.
fn norm_scores(results: &Results) -> Option<Vec<String>> {
    let (worlds, agents) = (results.worlds(), results.agents());
    let c51 = agents.iter().position(|agent| *agent == "c51")?;
    let scores = |of: &dyn Fn(&str, &str) -> Option<f64>| {
        let game = |world: &&str| agents.iter().map(|agent| of(world, agent)).collect();
        let games: Option<Vec<Vec<f64>>> = worlds.iter().map(game).collect();
        aggregate::norm_scores(&games?, c51)
    };
    let ours = scores(&|world, agent| {
        Spread::of(results.means(world, agent, Kind::Training)).map(|it| it.mean)
    })?;
    let paper = scores(&|world, agent| published::paper(world, agent).map(|it| it.0));
    let cells = ours.iter().enumerate().map(|(agent, ours)| match &paper {
        Some(paper) => format!("{ours:.2} (paper {:.2})", paper[agent]),
        None => format!("{ours:.2}"),
    });
    let head = ["norm. score".to_owned(), "-".to_owned()];
    Some(head.into_iter().chain(cells).collect())
}

fn plus_minus(mean: f64, sd: f64, count: usize) -> String {
    match count {
        1 => format!("{mean:.2}"),
        _ => format!("{mean:.2} ± {sd:.2}"),
    }
}

/// Played with the newest weights.
fn greedy(results: &Results) -> Table {
    let kinds = [Kind::Trained, Kind::Single, Kind::Unseen];
    let mut rows = Vec::new();
    for world in results.worlds() {
        let random = kinds.map(|kind| results.random[world].mean(kind));
        let mut row = vec![short(world).to_owned(), "random".into()];
        row.extend(random.map(|mean| mean.map_or("-".into(), |mean| format!("{mean:.2}"))));
        rows.push(row);
        for agent in results.agents() {
            let mut row = vec![short(world).to_owned(), agent.to_owned()];
            row.extend(kinds.map(|kind| {
                let spread = Spread::of(results.means(world, agent, kind));
                spread.map_or("-".into(), |it| plus_minus(it.mean, it.sd, it.count))
            }));
            rows.push(row);
        }
    }
    let header = [
        "game",
        "agent",
        "as trained",
        "levels trained on, one an episode",
        "unseen levels, one an episode",
    ];
    Table {
        header: header.map(String::from).to_vec(),
        rows,
    }
}

/// What DRIML-ada did.
fn actions(results: &Results) -> Table {
    let mut rows = Vec::new();
    for name in results.worlds() {
        let cells: Vec<&RunResult> = results
            .adaptive()
            .filter(|cell| cell.world == name)
            .collect();
        let Ok(world) = name.parse::<WorldName>() else {
            continue;
        };
        if cells.is_empty() {
            continue;
        }
        let mean = |of: &dyn Fn(&RunResult) -> f64| {
            let spread = Spread::of(cells.iter().map(|cell| of(cell)));
            spread.map_or("-".into(), |it| plus_minus(it.mean, it.sd, it.count))
        };
        let mut row = vec![short(name).to_owned()];
        row.push(mean(&|cell| cell.ran.summary.mean_k.unwrap_or(0.0)));
        row.extend((0..3).map(|kind| mean(&|cell| k::kinds(world, &cell.ran.summary)[kind])));
        rows.push(row);
    }
    let header = ["game", "mean k", "movement", "no-op", "special"];
    Table {
        header: header.map(String::from).to_vec(),
        rows,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::template;

    #[test]
    fn the_page_says_which_returns_are_of_fewer_episodes() {
        let summary = |resumed: u64, episodes: u64, of: u64| Summary {
            resumed_after_updates: resumed,
            episodes,
            mean_return_of: of,
            ..crate::made_up::summary()
        };
        let item = TEMPLATE
            .split("\n* ")
            .find(|it| it.starts_with("{if some_resumed}"));
        let said = |all: &[Summary]| {
            let mut values = Values::default();
            resumed(&all.iter().collect::<Vec<_>>(), &mut values);
            template::fill(&format!("* {}", item.unwrap()), &values)
        };
        assert_eq!(said(&[summary(0, 500, 0)]).trim(), "", "never interrupted");
        let good = said(&[summary(9, 500, 100), summary(9, 30, 30)]);
        assert!(good.starts_with("* 2 of 2 runs were interrupted"), "{good}");
        assert!(!good.contains("fewer than"), "{good}");
        let old = said(&[summary(9, 500, 3), summary(9, 500, 100)]);
        assert!(
            old.contains("training return of 1 of them is of fewer than the last 100"),
            "{old}"
        );
    }

    #[test]
    fn small_shares_keep_two_digits() {
        assert_eq!(
            [0.002, 0.000012, 0.5, 1.0].map(percent),
            ["0.20", "0.0012", "50", "100"]
        );
    }
}
