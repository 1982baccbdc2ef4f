//! The live view of a run: one progress display on a terminal, a plain line now and then elsewhere.
//! It asks no process: the launcher and the lockstep mode hand it the numbers.

use std::time::{Duration, Instant};

use driml_machine::units::duration;
use driml_protocol::{LearnerStatus, RecoveryProgress, ReplayStatus, Waiting};

use crate::{
    console::{self, Screen},
    rates::Rates,
    run_folder::{Episodes, ResumePoint},
};

/// How often a line is written where there is no terminal.
const PLAIN_PERIOD: Duration = Duration::from_secs(10);
/// How long updates go on before the rates are steady enough for a time left.
const STEADY_MIN: Duration = Duration::from_secs(5);
/// How long a part may be silent before it is said.
const SILENT_MAX: Duration = Duration::from_secs(10);
/// The progress display: how far, then two lines of numbers.
pub const TEMPLATE: &str = "{bar:40} {percent:>3}%  {elapsed_precise}\n{msg}";

/// The display name of an auxiliary loss: `DIM 4t4` of `dim_4t4`.
pub fn loss_title(name: &str) -> String {
    match name.split_once('_') {
        Some((kind, of_what)) => format!("{} {of_what}", kind.to_uppercase()),
        None => name.to_uppercase(),
    }
}

/// A count beside what is planned, which the last round may exceed: `8000/8000 (+192)`.
pub(crate) fn of_planned(count: u64, planned: u64) -> String {
    match count.saturating_sub(planned) {
        0 => format!("{count}/{planned}"),
        more => format!("{planned}/{planned} (+{more})"),
    }
}

/// The live view.
#[derive(Debug)]
pub struct Display {
    screen: Screen,
    frames_max: u64,
    updates_max: u64,
    /// Updates with which it began, and when the first beyond them was seen.
    updates_before: u64,
    learns_since: Option<Instant>,
    rates: Rates,
    /// When the run began: a terminal's bar has a clock of its own.
    began: Instant,
    plain_next: Instant,
}

impl Display {
    /// A view of a run of `frames_max` frames and `updates_max` updates that starts at `resume_point`.
    pub fn new(
        screen: Screen,
        frames_max: u64,
        updates_max: u64,
        resume_point: ResumePoint,
    ) -> Self {
        let mut rates = Rates::default();
        let began = Instant::now();
        rates.add(began, resume_point.frames, resume_point.updates);
        Self {
            screen,
            frames_max,
            updates_max,
            updates_before: resume_point.updates,
            learns_since: None,
            rates,
            began,
            plain_next: began + PLAIN_PERIOD,
        }
    }

    /// The view of a run that began at `began`.
    pub(crate) fn since(mut self, began: Instant) -> Self {
        self.began = began;
        self
    }

    /// Shows the state of the run, and `notes` under it, such as who does not answer.
    pub fn show(
        &mut self,
        replay: &ReplayStatus,
        learner: &LearnerStatus,
        episodes: Episodes,
        notes: &[String],
    ) {
        let now = Instant::now();
        self.rates
            .add(now, replay.transitions_inserted, learner.updates);
        if learner.updates > self.updates_before {
            self.learns_since.get_or_insert(now);
        }
        let mut texts = self.text(replay, learner, episodes).to_vec();
        if !notes.is_empty() {
            texts.push(notes.join("; "));
        }
        if let Some(bar) = self.screen.bar() {
            bar.set_position(replay.transitions_inserted.min(self.frames_max));
        }
        self.write(&texts);
    }

    /// Shows `note` in the place of the state of the run, which nobody can tell now.
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

    fn text(
        &self,
        replay: &ReplayStatus,
        learner: &LearnerStatus,
        episodes: Episodes,
    ) -> [String; 2] {
        let (frames_rate, updates_rate) = self.rates.per_second();
        let number = |value: Option<f64>, digits: usize| {
            value.map_or("-".into(), |value| format!("{value:.digits$}"))
        };
        // Before the first update there are none.
        let losses = self.learns_since.map_or(String::new(), |_| {
            let others = learner.losses.iter();
            let others = others.map(|(name, loss)| format!("  {} {loss:.3}", loss_title(name)));
            format!("  C51 {:.3}{}", learner.c51_kl, others.collect::<String>())
        });
        let k = replay
            .mean_k()
            .map_or(String::new(), |k| format!("  mean k {k:.2}"));
        let is_steady = |since: Instant| since.elapsed() >= STEADY_MIN;
        let left = self.learns_since.filter(|since| is_steady(*since));
        let left = left.and_then(|_| {
            let frames = self.frames_max.saturating_sub(replay.transitions_inserted);
            let updates = self.updates_max.saturating_sub(learner.updates);
            time_left((frames, frames_rate), (updates, updates_rate))
        });
        [
            format!(
                "frames {} ({frames_rate:.0}/s)  updates {} ({updates_rate:.1}/s)  replay ratio {}",
                of_planned(replay.transitions_inserted, self.frames_max),
                of_planned(learner.updates, self.updates_max),
                number(replay.replay_ratio(), 2),
            ),
            format!(
                "return {} ({} episodes){losses}{k}  {}{}",
                number(episodes.mean_return.map(|it| it.mean), 2),
                episodes.count,
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

/// What to say of a part that was heard so long ago; nothing of one that was heard just now.
pub(crate) fn silence(part: &str, heard: Instant) -> Option<String> {
    let silent = heard.elapsed();
    (silent >= SILENT_MAX).then(|| format!("{part}: no answer for {}", duration(silent)))
}

/// What to say of a replay server that reads its replay back.
pub(crate) fn recovery(server: &str, progress: RecoveryProgress) -> String {
    format!("{server}: reads its replay back from disk, {progress}")
}

/// Who waits for whom, and how many actors do.
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
    use expect_test::expect;

    use super::*;
    use crate::run_folder::MeanReturn;

    #[test]
    fn the_view_says_what_a_person_wants_to_know() {
        let mut display = Display::new(Screen::plain(), 200_000, 6_218, ResumePoint::default());
        let replay = ReplayStatus {
            transitions_inserted: 33_000,
            rows_sampled: 256_000,
            warmup_transitions: 1_000,
            k_histogram: vec![0, 1, 1, 2],
            waiting: Waiting::ActorsWaitForLearner,
            actors: 24,
            actors_waiting: 23,
            ..ReplayStatus::default()
        };
        let learner = LearnerStatus {
            updates: 1000,
            c51_kl: 0.1234,
            losses: vec![("dim_4t4".into(), 4.0)],
            ..LearnerStatus::default()
        };
        let episodes = Episodes {
            count: 45,
            mean_return: Some(MeanReturn {
                mean: 1.234,
                of: 45,
            }),
        };
        let start = Instant::now();
        display.rates = Rates::default();
        display.rates.add(start, 31_400, 950);
        display
            .rates
            .add(start + Duration::from_secs(10), 33_000, 1000);
        display.learns_since = start.checked_sub(STEADY_MIN);
        expect![[r#"
            frames 33000/200000 (160/s)  updates 1000/6218 (5.0/s)  replay ratio 8.00
            return 1.23 (45 episodes)  C51 0.123  DIM 4t4 4.000  mean k 2.25  23 of 24 actors wait for learner  17 min 23 s left"#]]
        .assert_eq(&display.text(&replay, &learner, episodes).join("\n"));
    }

    #[test]
    fn before_the_first_update_there_is_no_loss_and_no_time_left() {
        let mut display = Display::new(Screen::plain(), 8_000, 218, ResumePoint::default());
        let (mut replay, mut learner) = (ReplayStatus::default(), LearnerStatus::default());
        display.show(&replay, &learner, Episodes::default(), &[]);
        expect![[r#"
            frames 0/8000 (0/s)  updates 0/218 (0.0/s)  replay ratio -
            return - (0 episodes)  nobody waits"#]]
        .assert_eq(
            &display
                .text(&replay, &learner, Episodes::default())
                .join("\n"),
        );
        (replay.transitions_inserted, learner.updates) = (8_192, 224);
        display.rates = Rates::default();
        display.show(&replay, &learner, Episodes::default(), &[]);
        expect![[r#"
            frames 8000/8000 (+192) (0/s)  updates 218/218 (+6) (0.0/s)  replay ratio 0.00
            return - (0 episodes)  C51 0.000  nobody waits"#]]
        .assert_eq(
            &display
                .text(&replay, &learner, Episodes::default())
                .join("\n"),
        );
    }

    #[test]
    fn an_actor_that_has_gone_is_none_of_those_connected() {
        let with_connected = |actors| ReplayStatus {
            waiting: Waiting::ActorsWaitForLearner,
            actors,
            actors_waiting: 2,
            ..ReplayStatus::default()
        };
        let said = [2, 1].map(|actors| waiting(&with_connected(actors)));
        expect![[r#"
            2 of 2 actors wait for learner
            chunks of 2 actors wait for learner"#]]
        .assert_eq(&said.join("\n"));
    }

    #[test]
    fn a_plain_line_begins_with_the_time() {
        let texts = ["frames 1/2", "return 3"].map(str::to_owned);
        let said = plain(Duration::from_secs(83), &texts);
        assert_eq!(said, "1 min 23 s  frames 1/2  return 3");
    }

    #[test]
    fn no_time_is_left_to_guess_while_nothing_happens() {
        assert_eq!(time_left((10, 0.0), (0, 0.0)), None);
    }

    #[test]
    fn the_template_is_one() {
        assert!(indicatif::ProgressStyle::with_template(TEMPLATE).is_ok());
    }
}
