//! The page of table 1: what came out beside the paper, and what the length of the runs can tell.
//! Every number is made here from the runs.

use driml_envs::WorldName;
use driml_launch::run_folder::Summary;
use driml_protocol::RETURNS_OF;

use super::{
    Cell, Kind, Results, k, published,
    scores::{Aggregate, baseline},
    short,
};
use crate::{Page, aggregate, page::Table, statistics::Spread};

/// Frames of the paper's runs.
const PAPER_FRAMES: f64 = 50e6;
/// Standard errors from which on a mean return counts as different from the random policy's.
const ERRORS: f64 = 2.0;
/// Seeds a game from which on a bootstrap over them says something.
const SEEDS_MIN: u32 = 5;

/// The page.
pub(super) fn page(results: &Results, aggregates: &[Aggregate], adaptive: bool) -> Page {
    let settings = &results.settings;
    let share = settings.frames as f64 / PAPER_FRAMES;
    let mut figures = vec![
        ("curves".into(), "Training return by game".into()),
        ("aggregate".into(), "Scores over all games".into()),
    ];
    let mut data: Vec<(String, String)> = vec![
        ("runs".into(), "every run".into()),
        (
            "table".into(),
            "means and standard deviations over seeds, with the paper's".into(),
        ),
        ("curves".into(), "the lines of the first figure".into()),
        ("aggregate".into(), "the scores over all games".into()),
    ];
    let mut tables = vec![table_1(results), greedy(results)];
    if adaptive {
        tables.push(actions(results));
        figures.push(("k".into(), "k of DRIML-ada over the training".into()));
        figures.push((
            "affinity".into(),
            "The action affinity at the end, first seed".into(),
        ));
        data.push(("k".into(), "the lines of the figure of k".into()));
        data.push((
            "k_histogram".into(),
            "rows served with each k; 0 is none".into(),
        ));
        data.push(("actions".into(), "transitions with each action".into()));
    }
    Page {
        title: "Procgen (Table 1)".into(),
        claim: "After 50 million frames, C51 with a DIM objective earns more on most of the sixteen games: its norm. score is \
                1.9 for DRIML-ada and 1.48 for DRIML-fix, where C51's is 1."
            .into(),
        command: results.command.clone(),
        expected: vec![
            format!(
                "{} frames are {}% of the paper's. That is enough to see whether an agent has learned anything on a game at \
                 all, and how fast its first steps are.",
                settings.frames,
                percent(share)
            ),
            "It is not enough to confirm or refute the order of table 1: what an auxiliary loss gains late in a training cannot \
             be seen, and with few seeds only large differences are differences at all."
                .into(),
        ],
        got: got(results, aggregates),
        tables,
        differences: differences(results, share),
        setup: [
            Some(format!(
                "Preset {}{}; {} frames a run, {} seed(s); {} episodes played on each kind of levels with the newest weights, \
                 epsilon 0.001.",
                settings.preset,
                match &settings.sets[..] {
                    [] => String::new(),
                    sets => format!(" with {}", sets.join(", ")),
                },
                settings.frames,
                settings.seeds,
                settings.episodes
            )),
            (settings.seeds < SEEDS_MIN).then(|| {
                format!(
                    "The intervals are of {} seed(s) a game, and too narrow: so few values cannot tell how far others would spread. Take \
                     them for no less than the spread between these very seeds; `--seeds {SEEDS_MIN}` or more makes them intervals.",
                    settings.seeds
                )
            }),
            resumed(results),
            Some("Interquartile mean, probability of improvement and their intervals: Agarwal et al. 2021; 2,000 resamples of seeds \
             within each game. Normalisation: (return - min) / (max - min) with Cobbe et al. 2020, appendix C, mode easy. It \
             is made for single levels, so only returns of an episode a level are normalised."
                .into()),
        ]
        .into_iter()
        .flatten()
        .collect(),
        figures,
        data,
        smoke: results.smoke,
    }
}

/// That runs were interrupted and went on, if any were.
fn resumed(results: &Results) -> Option<String> {
    let summaries = results.cells.iter().map(|cell| &cell.ran.summary);
    said_of_resumed(&summaries.collect::<Vec<_>>())
}

fn said_of_resumed(all: &[&Summary]) -> Option<String> {
    let resumed = all.iter().filter(|it| it.resumed_after_updates > 0);
    let count = resumed.clone().count();
    // What an older version played before the interruption was not kept.
    let short = resumed.filter(|it| it.mean_return_of < it.episodes.min(RETURNS_OF as u64));
    let short = match short.count() {
        0 => String::new(),
        short => format!(
            " The training return of {short} of them is of fewer than the last {RETURNS_OF} episodes, those since."
        ),
    };
    (count > 0).then(|| {
        format!(
            "{count} of {} runs were interrupted and went on from a checkpoint, with a replay that had to fill again; of these, the \
             histogram of k and the shares of actions are of what came after.{short}",
            all.len()
        )
    })
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    let decimals = (1.0 - percent.log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{percent:.decimals$}")
}

fn got(results: &Results, aggregates: &[Aggregate]) -> Vec<String> {
    let mut lines = Vec::new();
    for agent in results.agents() {
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
        lines.push(format!(
            "`{agent}` plays better than at random, in every seed by {ERRORS} standard errors of its episodes as trained, on {} of {} \
             games{which}.",
            above.len(),
            played().count()
        ));
    }
    for it in aggregates {
        let what = match it.measure {
            "interquartile mean" => format!(
                "Interquartile mean of normalised returns, {}, `{}`",
                it.kind.name(),
                it.agent
            ),
            _ => format!(
                "Probability that `{}` is better than `{}`, {}",
                it.agent,
                baseline(results).unwrap_or_default(),
                it.kind.name()
            ),
        };
        lines.push(format!("{what}: {} ({} games).", it.estimate, it.games));
    }
    if !results.missing.is_empty() {
        lines.push(format!(
            "Missing, and in no number here: {}.",
            results.missing.join(", ")
        ));
    }
    lines
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

fn differences(results: &Results, share: f64) -> Vec<String> {
    let mut lines = vec![
        format!("The length: {}% of the paper's, and {} seeds instead of 3.", percent(share), results.settings.seeds),
        "The published code bootstraps its 7-step returns from s_{t+1}, lets positives cross episode ends and leaves the 500 \
         levels; ours does not, so its numbers are a reference and not what ours should become."
            .into(),
    ];
    if results.settings.preset != "split" {
        lines.push(
            "Levels are sequential, as in the paper: an episode goes on through the levels that are completed, so a return \
             can exceed a single level's, and returns as trained do not compare with those of an episode a level."
                .into(),
        );
    }
    let worlds = results.worlds();
    match worlds.iter().filter(|world| world.starts_with("procgen:")).count() {
        0 => lines.push("None of Procgen's games, but worlds that need no engine.".into()),
        games if games < 16 => lines.push(format!(
            "{games} of the sixteen games. `driml experiment procgen --screen` orders them by how soon C51 learns them; such a \
             choice favours C51, as the return alone teaches quickly there."
        )),
        _ => {}
    }
    lines
}

/// Ours beside the paper's.
fn table_1(results: &Results) -> Table {
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
    let mut caption = "Training return, mean of the last 100 episodes (of all, in a run that had fewer): mean ± standard deviation over \
                       seeds; in brackets the \
                       paper's (table 1; for driml-noact-k1 and -k5 its ablation) after 50 million frames."
        .to_owned();
    if let Some(row) = norm_scores(results) {
        rows.push(row);
        caption += " Norm. score: mean over these games of (return - worst agent's) / (best agent's - worst agent's), divided \
                    by c51's; the paper does not define it, and this formula gives its row from its table. The paper's in \
                    brackets is over the games and agents of this table.";
    }
    Table {
        caption,
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
        caption: format!(
            "Newest weights, {} episodes each: mean ± standard deviation over seeds.",
            results.settings.episodes
        ),
        header: header.map(String::from).to_vec(),
        rows,
    }
}

/// What DRIML-ada did.
fn actions(results: &Results) -> Table {
    let mut rows = Vec::new();
    for name in results.worlds() {
        let cells: Vec<&Cell> = results
            .adaptive()
            .filter(|cell| cell.world == name)
            .collect();
        let Ok(world) = name.parse::<WorldName>() else {
            continue;
        };
        if cells.is_empty() {
            continue;
        }
        let mean = |of: &dyn Fn(&Cell) -> f64| {
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
        caption: "DRIML-ada: mean k over the whole run, and shares of its actions by what they amount to in the game. The learned \
                  affinity starts uniform, where the mean k of 15 actions is 1.07, and takes some 1,500 updates to what the exact one \
                  (`learner.affinity.estimator=exact`) has at once: that k rises until then says nothing of the agent.".into(),
        header: header.map(String::from).to_vec(),
        rows,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_says_which_returns_are_of_fewer_episodes() {
        let summary = |resumed: u64, episodes: u64, of: u64| Summary {
            resumed_after_updates: resumed,
            episodes,
            mean_return_of: of,
            ..crate::made_up::summary()
        };
        let said = |all: &[Summary]| said_of_resumed(&all.iter().collect::<Vec<_>>());
        assert_eq!(said(&[summary(0, 500, 0)]), None, "never interrupted");
        let good = said(&[summary(9, 500, 100), summary(9, 30, 30)]).unwrap();
        assert!(good.starts_with("2 of 2 runs were interrupted"), "{good}");
        assert!(!good.contains("fewer than"), "{good}");
        let old = said(&[summary(9, 500, 3), summary(9, 500, 100)]).unwrap();
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
