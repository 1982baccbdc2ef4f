//! The live lines of a run: one progress display on a terminal, a plain line now and then elsewhere.
//! It asks no process.

use std::time::{Duration, Instant};

use driml_machine::units::duration;
use driml_protocol::{ReplayStatus, Waiting};

use crate::{
    console::{self, Screen},
    moment::Moment,
    run_view::Plan,
};

const PLAIN_PERIOD: Duration = Duration::from_secs(10);
/// How long updates run before the rates are steady enough to estimate the time left.
const STEADY_MIN: Duration = Duration::from_secs(5);
/// The progress display: how far, then two lines of numbers.
pub const TEMPLATE: &str = "{bar:40} {percent:>3}%  {elapsed_precise}\n{msg}";

/// The display name of an auxiliary loss: `DIM 4t4` of `dim_4t4`.
pub fn loss_title(name: &str) -> String {
    match name.split_once('_') {
        Some((kind, of_what)) => format!("{} {of_what}", kind.to_uppercase()),
        None => name.to_uppercase(),
    }
}

/// How far a run is and how fast; its frames are a question mark where they are not known, as are its updates.
pub(super) fn progress(plan: &Plan, moment: &Moment<'_>, is_known: bool) -> String {
    let count = |count: Option<u64>, planned| match count {
        Some(count) => of_planned(count, planned),
        None => format!("?/{planned}"),
    };
    let frames = is_known.then_some(moment.replay.transitions_inserted);
    format!(
        "frames {} ({:.0}/s)  updates {} ({:.1}/s)  replay ratio {}",
        count(frames, plan.frames_planned),
        moment.speed.frames,
        count(moment.learner.map(|it| it.updates), plan.updates_planned),
        moment.speed.updates,
        number(moment.replay.replay_ratio()),
    )
}

fn number(value: Option<f64>) -> String {
    value.map_or("-".into(), |value| format!("{value:.2}"))
}

/// A count beside what is planned, which the last round may exceed: `8000/8000 (+192)`.
fn of_planned(count: u64, planned: u64) -> String {
    match count.saturating_sub(planned) {
        0 => format!("{count}/{planned}"),
        more => format!("{planned}/{planned} (+{more})"),
    }
}

/// The live lines.
#[derive(Debug)]
pub struct Display {
    screen: Screen,
    plan: Plan,
    /// Updates with which it began, and when the first beyond them was seen.
    updates_before: u64,
    learns_since: Option<Instant>,
    /// When the run began: a terminal's bar has its own clock.
    began: Instant,
    plain_next: Instant,
}

impl Display {
    /// Of a run of this plan that began at `began`, and has done so many updates.
    pub fn new(screen: Screen, plan: Plan, began: Instant, updates_before: u64) -> Self {
        Self {
            screen,
            plan,
            updates_before,
            learns_since: None,
            began,
            plain_next: Instant::now() + PLAIN_PERIOD,
        }
    }

    /// Shows the state of the run, and `notes` under it, such as who does not answer.
    pub fn show(&mut self, moment: &Moment<'_>, notes: &[String]) {
        let updates = moment.learner.map_or(0, |it| it.updates);
        if updates > self.updates_before {
            self.learns_since.get_or_insert_with(Instant::now);
        }
        let mut texts = self.text(moment).to_vec();
        if !notes.is_empty() {
            texts.push(notes.join("; "));
        }
        if let Some(bar) = self.screen.bar() {
            let frames = moment.replay.transitions_inserted;
            bar.set_position(frames.min(self.plan.frames_planned));
        }
        self.write(&texts);
    }

    /// Shows `note` in the place of the state of the run, which is not known now.
    pub(crate) fn show_alone(&mut self, note: &str) {
        self.write(&[note.to_owned()]);
    }

    fn write(&mut self, texts: &[String]) {
        let now = Instant::now();
        match self.screen.bar() {
            Some(bar) => bar.set_message(console::wrapped(&texts.join("\n"), "  ", 0)),
            None if now >= self.plain_next => {
                self.plain_next = now + PLAIN_PERIOD;
                self.screen.line(&plain(now - self.began, texts));
            }
            None => {}
        }
    }

    fn text(&self, moment: &Moment<'_>) -> [String; 2] {
        let (replay, speed) = (moment.replay, moment.speed);
        let frames = replay.transitions_inserted;
        let updates = moment.learner.map_or(0, |it| it.updates);
        // Before the first update there are none.
        let learned = moment.learner.filter(|_| self.learns_since.is_some());
        let losses = learned.map(|it| {
            let others = it.losses.iter();
            let others = others.map(|(name, loss)| format!("  {} {loss:.3}", loss_title(name)));
            format!("  C51 {:.3}{}", it.c51_kl, others.collect::<String>())
        });
        let losses = losses.unwrap_or_default();
        let k = moment.k.map(|k| format!("  mean k {:.2}", k.mean));
        let k = k.unwrap_or_default();
        let is_steady = |since: &Instant| since.elapsed() >= STEADY_MIN;
        let left = self.learns_since.filter(is_steady).and_then(|_| {
            let frames = self.plan.frames_planned.saturating_sub(frames);
            let updates = self.plan.updates_planned.saturating_sub(updates);
            time_left((frames, speed.frames), (updates, speed.updates))
        });
        [
            progress(&self.plan, moment, true),
            format!(
                "return {} ({} episodes){losses}{k}  {}{}",
                number(moment.episodes.mean_return),
                moment.episodes.count,
                waiting(replay),
                left.map_or(String::new(), |left| format!("  {} left", duration(left))),
            ),
        ]
    }
}

/// The line of a view without a terminal, that long after the run began.
fn plain(elapsed: Duration, texts: &[String]) -> String {
    format!("{}  {}", duration(elapsed), texts.join("  "))
}

fn waiting(replay: &ReplayStatus) -> String {
    match (replay.waiting, replay.actors_waiting) {
        (Waiting::ActorsWaitForLearner, waiting @ 1..) if waiting <= replay.actors => {
            format!("{waiting} of {} actors wait for learner", replay.actors)
        }
        // The chunk of an actor that has gone waits too.
        (Waiting::ActorsWaitForLearner, waiting @ 1..) => {
            format!("chunks of {waiting} actors wait for learner")
        }
        (waiting, _) => waiting.to_string(),
    }
}

/// The longer of what frames and updates still take; none while something is left of which nothing happens.
fn time_left(frames: (u64, f64), updates: (u64, f64)) -> Option<Duration> {
    let seconds = |(left, rate): (u64, f64)| match left {
        0 => Some(0.0),
        _ if rate > 0.0 => Some(left as f64 / rate),
        _ => None,
    };
    let longer = seconds(frames)?.max(seconds(updates)?);
    Duration::try_from_secs_f64(longer).ok()
}

#[cfg(test)]
mod tests {
    use driml_protocol::LearnerStatus;
    use expect_test::expect;

    use super::*;
    use crate::{
        moment::{Speed, Spread},
        run_view::RunView,
        testing::with,
    };

    fn display(frames_planned: u64, updates_planned: u64) -> Display {
        let plan = with(|it: &mut Plan| {
            (it.frames_planned, it.updates_planned) = (frames_planned, updates_planned);
        });
        Display::new(Screen::plain(), plan, Instant::now(), 0)
    }

    fn view(replay: ReplayStatus, learner: LearnerStatus) -> RunView {
        let mut view = RunView::new(Plan::default());
        view.take_learner(Some(learner));
        view.take_replay(vec![replay]);
        view
    }

    #[test]
    fn the_lines_say_what_a_person_wants_to_know() {
        let mut display = display(200_000, 6_218);
        let replay = ReplayStatus {
            transitions_inserted: 33_000,
            rows_sampled: 256_000,
            warmup_transitions: 1_000,
            waiting: Waiting::ActorsWaitForLearner,
            actors: 24,
            actors_waiting: 23,
            ..ReplayStatus::default()
        };
        let learner = with(|it: &mut LearnerStatus| {
            (it.updates, it.c51_kl) = (1000, 0.1234);
            it.losses = vec![("dim_4t4".into(), 4.0)];
        });
        let (mean, sd) = (2.25, 1.0);
        let (frames, updates) = (160.0, 5.0);
        let view = view(replay, learner);
        let mut moment = view.moment();
        (moment.episodes.count, moment.episodes.mean_return) = (45, Some(1.234));
        moment.k = Some(Spread { mean, sd });
        moment.speed = Speed { frames, updates };
        display.learns_since = Instant::now().checked_sub(STEADY_MIN);
        expect![[r#"
            frames 33000/200000 (160/s)  updates 1000/6218 (5.0/s)  replay ratio 8.00
            return 1.23 (45 episodes)  C51 0.123  DIM 4t4 4.000  mean k 2.25  23 of 24 actors wait for learner  17 min 23 s left"#]]
        .assert_eq(&display.text(&moment).join("\n"));
    }

    #[test]
    fn before_the_first_update_there_is_no_loss_and_no_time_left() {
        let mut display = display(8_000, 218);
        let mut shown = |frames, updates| {
            let replay = with(|it: &mut ReplayStatus| it.transitions_inserted = frames);
            let view = view(replay, with(|it: &mut LearnerStatus| it.updates = updates));
            display.show(&view.moment(), &[]);
            display.text(&view.moment()).join("\n")
        };
        expect![[r#"
            frames 0/8000 (0/s)  updates 0/218 (0.0/s)  replay ratio -
            return - (0 episodes)  neither side waits"#]]
        .assert_eq(&shown(0, 0));
        expect![[r#"
            frames 8000/8000 (+192) (0/s)  updates 218/218 (+6) (0.0/s)  replay ratio 0.00
            return - (0 episodes)  C51 0.000  neither side waits"#]]
        .assert_eq(&shown(8_192, 224));
        let nothing_happens = (10, 0.0);
        assert_eq!(time_left(nothing_happens, (0, 0.0)), None);
    }

    #[test]
    fn an_actor_that_has_gone_is_none_of_those_connected() {
        let said = [2, 1].map(|actors| {
            waiting(&with(|it: &mut ReplayStatus| {
                it.waiting = Waiting::ActorsWaitForLearner;
                (it.actors, it.actors_waiting) = (actors, 2);
            }))
        });
        let expected = [
            "2 of 2 actors wait for learner",
            "chunks of 2 actors wait for learner",
        ];
        assert_eq!(said, expected);
    }

    #[test]
    fn a_plain_line_begins_with_the_time() {
        let texts = ["frames 1/2", "return 3"].map(str::to_owned);
        let said = plain(Duration::from_secs(83), &texts);
        assert_eq!(said, "1 min 23 s  frames 1/2  return 3");
        assert!(indicatif::ProgressStyle::with_template(TEMPLATE).is_ok());
    }
}
