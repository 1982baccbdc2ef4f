//! On which games C51 learns soonest: short runs on all of them, each beside a random policy.
//! It chooses nothing by itself; the page has the order and says how it was made.

use driml_figure::{Axis, Chart, Figure, GREY, Mark, Panel, Series};
use driml_protocol::RETURNS_OF;

use super::{
    grid::short,
    results::{Kind, Results, RunResult},
};
use crate::{
    page::{Page, Table},
    plot::{Run, over_seeds},
    session::Session,
    statistics::Spread,
    template::Values,
};

/// Standard errors by which a mean return must exceed the random policy's: with sixteen games, 2 would be passed by luck.
const ERRORS: f64 = 3.0;
/// Training episodes before their mean counts.
const EPISODES_MIN: f64 = 20.0;
/// Standard errors below which a proposed game is called a guess.
const GUESSED: f64 = 2.0;
/// Games that the page proposes.
const CHOSEN: usize = 3;

/// How soon a game was learned.
struct Screened {
    world: String,
    random: Spread,
    /// Frames after which the training return stayed above chance; none if it did not.
    soonest: Option<f64>,
    training: f64,
    greedy: f64,
    /// (greedy - random) in standard errors of that difference.
    errors: f64,
}

/// Writes data, figure and page.
pub(super) fn report(session: Session, results: &Results) -> anyhow::Result<()> {
    let mut screened = Vec::new();
    for cell in &results.cells {
        screened.extend(screen(results, cell)?);
    }
    // Those that stayed above chance, soonest first; then the others, surest first.
    screened.sort_by(|a, b| {
        let key = |it: &Screened| it.soonest.unwrap_or(f64::INFINITY);
        key(a)
            .total_cmp(&key(b))
            .then(b.errors.total_cmp(&a.errors))
    });
    let header = [
        "world",
        "frames_until_above_random",
        "training_return",
        "greedy_return",
        "random_return",
        "random_sd",
        "greedy_minus_random_in_standard_errors",
    ];
    let rows = screened.iter().map(|it| {
        let soonest = it
            .soonest
            .map_or(String::new(), |frames| frames.to_string());
        let numbers = [
            it.training,
            it.greedy,
            it.random.mean,
            it.random.sd,
            it.errors,
        ];
        let numbers = numbers.map(|number| format!("{number:.4}"));
        [it.world.clone(), soonest]
            .into_iter()
            .chain(numbers)
            .collect()
    });
    session.csv("screen", &header, rows)?;
    session.figure("screen", &figure(results, &screened)?)?;
    session.finish(&page(results, &screened))
}

fn screen(results: &Results, cell: &RunResult) -> anyhow::Result<Option<Screened>> {
    let random = Spread::of(results.random[&cell.world].trained.iter().copied());
    let greedy = Spread::of(cell.played.trained.iter().copied());
    let (Some(random), Some(greedy)) = (random, greedy) else {
        return Ok(None);
    };
    let error = |spread: &Spread| spread.sd.powi(2) / spread.count as f64;
    let apart = greedy.mean - random.mean;
    let errors = match (error(&random) + error(&greedy)).sqrt() {
        0.0 => 0.0,
        sum => apart / sum,
    };
    Ok(Some(Screened {
        world: cell.world.clone(),
        soonest: soonest(&Run::read(&cell.ran.folder)?, &random)?,
        training: cell.score(Kind::Training).unwrap_or(f64::NAN),
        greedy: greedy.mean,
        random,
        errors,
    }))
}

/// The frames after which the mean return of the last 100 training episodes stayed above the random policy's mean by
/// `ERRORS` standard errors of a mean of as many of its episodes, to the end of the run.
fn soonest(run: &Run, random: &Spread) -> anyhow::Result<Option<f64>> {
    let returns = run.values("mean_return")?;
    // Of how many episodes it is; runs of older versions, which cannot be resumed by this one, only have the count of all.
    let episodes = run
        .values("mean_return_of")
        .or_else(|_| run.values("episodes"))?;
    let mut since = None;
    // Once known, the return is in every row: the last rows of both belong together.
    for (row, episodes) in returns.iter().rev().zip(episodes.iter().rev()) {
        let error = random.sd / episodes.1.clamp(1.0, RETURNS_OF as f64).sqrt();
        if episodes.1 < EPISODES_MIN || row.1 <= random.mean + ERRORS * error {
            break;
        }
        since = Some(row.0);
    }
    Ok(since)
}

fn figure(results: &Results, screened: &[Screened]) -> anyhow::Result<Figure> {
    let mut panels = Vec::new();
    for it in screened {
        let mut curves = Vec::new();
        for cell in results.cells.iter().filter(|cell| cell.world == it.world) {
            curves.push(Run::read(&cell.ran.folder)?.values("mean_return")?);
        }
        let curve = over_seeds(&curves);
        let ends = vec![
            (0.0, it.random.mean),
            (results.settings.frames as f64, it.random.mean),
        ];
        let series = vec![
            Series::line("random policy", 0, ends)
                .coloured(GREY)
                .marked(Mark::Dashed),
            Series::line("c51", 0, curve.points).banded(curve.band),
        ];
        panels.push(Panel::Chart(Chart::new(
            short(&it.world),
            Axis::linear("frames"),
            Axis::linear("mean return"),
            series,
        )));
    }
    Ok(Figure {
        title: "C51 in its first frames, soonest learned first".into(),
        notes: vec![
            "Training return, mean of the last 100 episodes, with exploration; the random policy's mean on the same levels."
                .into(),
        ],
        columns: 4,
        panel_size: (300.0, 230.0),
        panels,
    })
}

fn page(results: &Results, screened: &[Screened]) -> Page {
    let settings = &results.settings;
    let above = screened.iter().filter(|it| it.soonest.is_some()).count();
    let chosen = screened.iter().take(CHOSEN);
    let chosen: Vec<&str> = chosen.map(|it| short(&it.world)).collect();
    let guessed = screened.iter().take(CHOSEN);
    let guessed: Vec<&str> = guessed
        .filter(|it| it.soonest.is_none() && it.errors < GUESSED)
        .map(|it| short(&it.world))
        .collect();
    let by_greedy = CHOSEN.saturating_sub(above).min(screened.len());
    let rows = screened.iter().map(|it| {
        vec![
            short(&it.world).to_owned(),
            it.soonest
                .map_or("-".into(), |frames| format!("{frames:.0}")),
            format!("{:.2}", it.training),
            format!("{:.2}", it.greedy),
            format!("{:.2}", it.random.mean),
            format!("{:.1}", it.errors),
        ]
    });
    let header = [
        "game",
        "frames until above random",
        "training return",
        "greedy return",
        "random return",
        "greedy - random [standard errors]",
    ];
    let table = Table {
        header: header.map(String::from).to_vec(),
        rows: rows.collect(),
    };
    let mut values = Values::default();
    values
        .set("above", above)
        .set("games", screened.len())
        .when("by_greedy", by_greedy > 0)
        .set("greedy_count", by_greedy)
        .set("chosen_count", CHOSEN)
        .set("chosen", chosen.join(","))
        .when("some_guessed", !guessed.is_empty())
        .set("guessed", guessed.join(", "))
        .set("guess_errors", GUESSED)
        .set("table", table);
    values
        .set("errors", ERRORS)
        .set("episodes_min", EPISODES_MIN)
        .set("episodes", settings.episodes)
        .set("agents", settings.agents.join(", "))
        .set("preset", &settings.preset)
        .set("frames", settings.frames)
        .set("seeds", settings.seeds);
    let template = include_str!("screen.md");
    Page::new(template, values, &results.command, results.smoke)
}

#[cfg(test)]
mod tests {
    use driml_launch::run_folder::RunFolder;

    use super::*;

    #[test]
    fn a_game_counts_from_where_its_return_stays_above_chance() {
        let folder = tempfile::tempdir().unwrap();
        let random = Spread::of([0.0, 1.0, 0.0, 1.0]).unwrap();
        let read = |text: &str| {
            let text = format!("seconds,frames,episodes,mean_return\n{text}");
            std::fs::write(folder.path().join("metrics.csv"), text).unwrap();
            soonest(&Run::read(&RunFolder::new(folder.path())).unwrap(), &random).unwrap()
        };
        // Chance is 0.5 with 0.58; three standard errors of 100 episodes are 0.17.
        let rows = "1,0,0,\n2,100,30,2\n3,200,100,0.6\n4,300,100,0.7\n5,400,100,0.8\n";
        assert_eq!(read(rows), Some(300.0));
        assert_eq!(read("1,100,100,0.9\n2,200,100,0.5\n"), None);
        assert_eq!(read("1,100,5,9\n"), None, "too few episodes");
        // 30 episodes, though the run has had 200: three standard errors are 0.32.
        let text = "seconds,frames,episodes,mean_return,mean_return_of\n1,100,200,0.8,30\n2,200,210,0.9,40\n";
        std::fs::write(folder.path().join("metrics.csv"), text).unwrap();
        let found = soonest(&Run::read(&RunFolder::new(folder.path())).unwrap(), &random).unwrap();
        assert_eq!(found, Some(200.0));
    }
}
