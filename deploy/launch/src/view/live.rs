//! The live lines of a run: a progress display on a terminal, and a plain line every ten seconds elsewhere.
//! This module asks no process.

use std::time::{Duration, Instant};

use driml_machine::units::{count, duration};
use driml_protocol::{ReplayStatus, Waiting};

use super::advice::notes;
use crate::{
    console::{self, Screen},
    run_view::RunView,
};

/// How long updates must run before the rates are steady enough to estimate the time left.
const STEADY_MIN: Duration = Duration::from_secs(5);
/// The template of the progress display: a bar, then two lines of numbers.
pub const PROGRESS_TEMPLATE: &str = "{bar:40} {percent:>3}%  {elapsed_precise}\n{msg}";

/// The display name of an auxiliary loss: `DIM 4t4` of `dim_4t4`.
pub fn loss_title(name: &str) -> String {
    match name.split_once('_') {
        Some((kind, of_what)) => format!("{} {of_what}", kind.to_uppercase()),
        None => name.to_uppercase(),
    }
}

/// The progress and the speed of a run; unknown frames and updates are shown as question marks, an unknown speed as dashes.
pub(super) fn progress_text(view: &RunView, frames: Option<u64>, updates: Option<u64>) -> String {
    // The last round may exceed the plan.
    let count = |count: Option<u64>, planned| match count {
        None => format!("?/{planned}"),
        Some(count) if count > planned => format!("{planned}/{planned} (+{})", count - planned),
        Some(count) => format!("{count}/{planned}"),
    };
    format!(
        "frames {} ({}/s)  updates {} ({}/s)  replay ratio {}",
        count(frames, view.plan.frames_planned),
        decimals(0, view.speed.map(|it| it.frames)),
        count(updates, view.plan.updates_planned),
        decimals(1, view.speed.map(|it| it.updates)),
        decimals(2, view.replay.replay_ratio()),
    )
}

fn decimals(digits: usize, value: Option<f64>) -> String {
    value.map_or("-".into(), |value| format!("{value:.digits$}"))
}

#[derive(Debug)]
pub(crate) struct Display {
    pub(crate) screen: Screen,
    /// When the first update since the run's last start was seen.
    learning_since: Option<Instant>,
    /// When the run began; a terminal's bar has a separate clock.
    began: Instant,
}

impl Display {
    pub(crate) fn new(frames: u64, began: Instant) -> Self {
        Self {
            screen: Screen::new(frames, PROGRESS_TEMPLATE),
            learning_since: None,
            began,
        }
    }

    /// Shows the state of the run, and notes below it, such as which process does not answer.
    pub(crate) fn show(&mut self, view: &RunView) {
        let has_learned = |before: u64| view.learner.updates > before;
        if view.after_updates.is_some_and(has_learned) {
            self.learning_since.get_or_insert_with(Instant::now);
        }
        let mut texts = self.lines(view).to_vec();
        let notes = notes(view);
        texts.extend((!notes.is_empty()).then(|| notes.join("; ")));
        let frames = view.replay.transitions_inserted;
        let position = frames.min(view.plan.frames_planned);
        self.screen.show(position, |is_bar| match is_bar {
            true => console::wrap(&texts.join("\n"), "  ", 0),
            false => format!("{}  {}", duration(self.began.elapsed()), texts.join("  ")),
        });
    }

    fn lines(&self, view: &RunView) -> [String; 2] {
        let (plan, learner) = (&view.plan, &view.learner);
        let (frames, updates) = (view.replay.transitions_inserted, learner.updates);
        // Before the first update there are no losses.
        let losses = self.learning_since.map(|_| {
            let others = learner.losses.iter();
            let others = others.map(|(name, loss)| format!("  {} {loss:.3}", loss_title(name)));
            format!("  C51 {:.3}{}", learner.c51_kl, others.collect::<String>())
        });
        let losses = losses.unwrap_or_default();
        let k = view.k.map(|k| format!("  mean k {:.2}", k.mean));
        let is_steady = |since: &Instant| since.elapsed() >= STEADY_MIN;
        let since = self.learning_since.filter(is_steady);
        let left = since.zip(view.speed).and_then(|(_, speed)| {
            let frames = plan.frames_planned.saturating_sub(frames);
            let updates = plan.updates_planned.saturating_sub(updates);
            time_left((frames, speed.frames), (updates, speed.updates))
        });
        let episodes = view.episodes;
        [
            progress_text(view, Some(frames), Some(updates)),
            format!(
                "return {} ({}){losses}{}  {}{}",
                decimals(2, episodes.mean_return),
                count(episodes.count, "episode"),
                k.unwrap_or_default(),
                waiting_text(&view.replay),
                left.map_or(String::new(), |left| format!("  {} left", duration(left))),
            ),
        ]
    }
}

fn waiting_text(replay: &ReplayStatus) -> String {
    match (replay.waiting, replay.actors_waiting) {
        (Waiting::ActorsWaitForLearner, waiting @ 1..) if waiting <= replay.actors => {
            let actors = count(replay.actors, "actor");
            format!("waiting for learner: {waiting} of {actors}")
        }
        // The chunk of an actor that has disconnected waits too.
        (Waiting::ActorsWaitForLearner, waiting @ 1..) => {
            let actors = count(waiting, "actor");
            format!("waiting for learner: chunks of {actors}")
        }
        (waiting, _) => waiting.to_string(),
    }
}

/// The longer of the times that frames and updates still take; none if one of them is incomplete and makes no progress.
fn time_left(frames: (u64, f64), updates: (u64, f64)) -> Option<Duration> {
    let seconds = |(left, rate): (u64, f64)| match left {
        0 => Some(0.0),
        _ if rate > 0.0 => Some(left as f64 / rate),
        _ => None,
    };
    Duration::try_from_secs_f64(seconds(frames)?.max(seconds(updates)?)).ok()
}

#[cfg(test)]
mod tests {
    use driml_protocol::LearnerStatus;
    use expect_test::expect;

    use super::*;
    use crate::{
        run_view::{Plan, Speed, Spread},
        testing::{make, view},
    };

    fn plan(frames: u64, updates: u64) -> Plan {
        make(|it: &mut Plan| (it.frames_planned, it.updates_planned) = (frames, updates))
    }

    #[test]
    fn the_lines_say_what_a_person_wants_to_know() {
        let mut display = Display::new(8_000, Instant::now());
        let replay = ReplayStatus {
            transitions_inserted: 33_000,
            rows_sampled: 256_000,
            warmup_transitions: 1_000,
            waiting: Waiting::ActorsWaitForLearner,
            actors: 24,
            actors_waiting: 23,
            ..ReplayStatus::default()
        };
        let learner = make(|it: &mut LearnerStatus| {
            (it.updates, it.c51_kl) = (1000, 0.1234);
            it.losses = vec![("dim_4t4".into(), 4.0)];
        });
        let mut view = view(plan(200_000, 6_218), replay, Some(learner));
        (view.episodes.count, view.episodes.mean_return) = (45, Some(1.234));
        let (mean, sd, frames, updates) = (2.25, 1.0, 160.0, 5.0);
        view.k = Some(Spread { mean, sd });
        view.speed = Some(Speed { frames, updates });
        display.learning_since = Instant::now().checked_sub(STEADY_MIN);
        expect![[r#"
            frames 33000/200000 (160/s)  updates 1000/6218 (5.0/s)  replay ratio 8.00
            return 1.23 (45 episodes)  C51 0.123  DIM 4t4 4.000  mean k 2.25  waiting for learner: 23 of 24 actors  17 min 23 s left"#]]
        .assert_eq(&display.lines(&view).join("\n"));
    }

    #[test]
    fn before_the_first_update_there_is_no_loss_and_no_time_left() {
        let mut display = Display::new(8_000, Instant::now());
        let mut shown = |frames, updates| {
            let replay = make(|it: &mut ReplayStatus| it.transitions_inserted = frames);
            let learner = make(|it: &mut LearnerStatus| it.updates = updates);
            let mut view = view(plan(8_000, 218), replay, Some(learner));
            view.after_updates = Some(0);
            display.show(&view);
            display.lines(&view).join("\n")
        };
        expect![[r#"
            frames 0/8000 (-/s)  updates 0/218 (-/s)  replay ratio -
            return - (0 episodes)  neither side waits"#]]
        .assert_eq(&shown(0, 0));
        expect![[r#"
            frames 8000/8000 (+192) (-/s)  updates 218/218 (+6) (-/s)  replay ratio 0.00
            return - (0 episodes)  C51 0.000  neither side waits"#]]
        .assert_eq(&shown(8_192, 224));
        assert_eq!(time_left((10, 0.0), (0, 0.0)), None, "no progress");
    }

    #[test]
    fn an_actor_that_has_gone_is_none_of_those_connected() {
        let said = [2, 1].map(|actors| {
            waiting_text(&make(|it: &mut ReplayStatus| {
                it.waiting = Waiting::ActorsWaitForLearner;
                (it.actors, it.actors_waiting) = (actors, 2);
            }))
        });
        let expected = [
            "waiting for learner: 2 of 2 actors",
            "waiting for learner: chunks of 2 actors",
        ];
        assert_eq!(said, expected);
    }
}
