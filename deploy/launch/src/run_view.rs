//! The state of a run as its processes report it: their last answers, the age of each answer, and the speed of the run.
//! This module asks no process: the poller and the lockstep mode pass it the answers.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use driml_actor::Schedule;
use driml_protocol::{
    LearnerStatus, ProcessesStatus, RecoveryProgress, ReplayStatus, Silence, Waiting,
};
use driml_settings::config::RunConfig;
use serde::{Deserialize, Serialize};

/// What a run is planned to do, by its settings.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Plan {
    pub(crate) world: String,
    pub(crate) agent: String,
    pub(crate) seed: u64,
    /// Hash of everything on which all processes of the run agree: an equal hash means the same run.
    pub(crate) run_spec: String,
    pub(crate) frames_planned: u64,
    pub(crate) updates_planned: u64,
    /// Rows sampled per stored transition.
    pub(crate) replay_ratio_planned: f64,
    pub(crate) actors_planned: u32,
    /// Replay servers of the run.
    #[serde(skip)]
    pub(crate) shards: u32,
    /// The schedule of the probability of a random action, common to all actors; none if they differ in it.
    #[serde(skip)]
    pub(crate) epsilon: Option<Schedule>,
    #[serde(skip)]
    pub(crate) losses: &'static [&'static str],
}

impl Plan {
    /// The plan of a run with these settings.
    pub fn new(config: &RunConfig) -> Self {
        let is_common = config.actor.epsilon_ladder.is_none();
        Self {
            world: config.run.world.clone(),
            agent: config.run.agent.clone(),
            seed: config.run.seed,
            run_spec: format!("{:016x}", config.run.hash()),
            frames_planned: config.frames(),
            updates_planned: config.updates(),
            replay_ratio_planned: config.replay.replay_ratio,
            actors_planned: config.local.actors,
            shards: config.replay.shards,
            // Without a ladder, the schedule of actor 0 is the schedule of every actor.
            epsilon: Schedule::new(&config.actor, 0).ok().filter(|_| is_common),
            losses: config.learner.update.auxiliary_loss.loss_names(),
        }
    }
}

/// The updates whose batches have been served once the whole run has sampled `rows` rows, even if a resume changed the batch size.
pub(crate) fn updates_served(config: &RunConfig, rows: u64) -> u64 {
    let start = config.replay.ratio_start();
    start.updates + rows.saturating_sub(start.rows) / u64::from(config.learner.batch_size)
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Spread {
    pub(crate) mean: f64,
    pub(crate) sd: f64,
}

/// The training episodes so far, including those before a resume.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Episodes {
    pub(crate) count: u64,
    /// Mean return of the newest episodes; none before the first one.
    pub(crate) mean_return: Option<f64>,
    /// Number of episodes in the mean: 100, or all if there were fewer.
    pub(crate) mean_return_of: usize,
}

impl Spread {
    /// The spread of k over the rows that were served with a positive.
    pub(crate) fn of_k(replay: &ReplayStatus) -> Option<Self> {
        let both = replay.mean_k().zip(replay.sd_k());
        both.map(|(mean, sd)| Self { mean, sd })
    }
}

impl Episodes {
    /// `count` episodes, of which `newest` holds the newest returns.
    pub(crate) fn new<'a>(count: u64, newest: impl ExactSizeIterator<Item = &'a f64>) -> Self {
        let of = newest.len();
        let sum: f64 = newest.sum();
        Self {
            count,
            mean_return: (of > 0).then(|| sum / of as f64),
            mean_return_of: of,
        }
    }
}

#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct ServerAnswer {
    #[serde(skip)]
    pub(crate) name: String,
    pub(crate) endpoint: String,
    pub(crate) replay: Option<ReplayStatus>,
    /// The processes that take part in the run; none if the server does not answer, or has not answered yet.
    pub(crate) processes: Option<ProcessesStatus>,
    /// Progress of reading the replay back from disk. The server answers no other request before that is done.
    pub(crate) recovering: Option<RecoveryProgress>,
    pub(crate) error: Option<String>,
    /// Nothing listens at the endpoint any more: the server's process has ended.
    pub(crate) is_gone: bool,
    /// The server answers, but for a run with other settings.
    pub(crate) is_another_run: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
pub(crate) struct Speed {
    #[serde(rename = "frames_per_second")]
    pub(crate) frames: f64,
    #[serde(rename = "updates_per_second")]
    pub(crate) updates: f64,
}

const RATE_WINDOW: Duration = Duration::from_secs(20);
/// A rate over less time says little: counts arrive in lumps.
const RATE_TIME_MIN: Duration = Duration::from_millis(500);
/// No answers for so long are a pause: this process or the others were stopped. The speed does not count it.
pub(crate) const PAUSE_MIN: Duration = Duration::from_secs(15);

/// The time of a sample, and the frames and updates counted by then.
type Sample = (Instant, u64, u64);

#[derive(Clone, Debug, Default)]
struct Rates(VecDeque<Sample>);

impl Rates {
    fn add(&mut self, now: Instant, frames: u64, updates: u64) {
        if self.0.back().is_some_and(|it| now - it.0 >= PAUSE_MIN) {
            self.0.clear();
        }
        self.0.push_back((now, frames, updates));
        while self.0.len() > 2 && now - self.0[1].0 >= RATE_WINDOW {
            self.0.pop_front();
        }
    }

    /// The rate of each count since it last stood at its oldest value in the window, at least for [`RATE_TIME_MIN`]; 0 before that.
    fn speed(&self) -> Speed {
        let rate = |count: fn(&Sample) -> u64| {
            let (first, last) = (self.0.front()?, self.0.back()?);
            let mut newest_first = self.0.iter().rev();
            let idle = newest_first
                .find(|it| count(it) == count(first) && last.0 - it.0 >= RATE_TIME_MIN)?;
            let seconds = (last.0 - idle.0).as_secs_f64();
            Some(count(last).saturating_sub(count(idle)) as f64 / seconds)
        };
        Speed {
            frames: rate(|it| it.1).unwrap_or(0.0),
            updates: rate(|it| it.2).unwrap_or(0.0),
        }
    }
}

/// Everything that is known about a run.
#[derive(Clone, Debug, Default)]
pub struct RunView {
    pub(crate) plan: Plan,
    /// Updates after which the run was last resumed, 0 if it never was; none before that is known.
    pub(crate) after_updates: Option<u64>,
    pub(crate) servers: Vec<ServerAnswer>,
    /// The replay servers' counts, from the last time that all of them answered.
    pub(crate) shards: Vec<ReplayStatus>,
    /// The same counts, merged into one.
    pub replay: ReplayStatus,
    /// The learner's last status.
    pub learner: LearnerStatus,
    pub(crate) is_learner_answering: bool,
    /// For how long at least one replay server has not answered, and for how long the learner has not.
    pub(crate) replay_silence: Silence,
    pub(crate) learner_silence: Silence,
    /// Whether the learner has ever answered, or the counts at the start are known without it.
    is_learner_known: bool,
    /// Episodes, and k of the rows served: of the whole run if a recorder fills them in, else since the replay began to count.
    pub(crate) episodes: Episodes,
    pub(crate) k: Option<Spread>,
    /// Duration of the whole run, seconds; none without a recorder, or before it has filled in the last answers.
    pub(crate) recorded_s: Option<f64>,
    /// Resident memory of each process by name, MiB, filled in by the recorder; none for a process that has ended.
    pub(crate) rss_mib: Vec<(String, Option<f64>)>,
    rates: Rates,
    /// None until it is known: from the run's beginning, or once the run was observed for [`RATE_WINDOW`].
    pub(crate) speed: Option<Speed>,
}

impl RunView {
    /// The view of a run without any answer yet.
    pub fn new(plan: Plan) -> Self {
        Self {
            plan,
            ..Self::default()
        }
    }

    /// Notes that the run begins now, with these counts.
    pub(crate) fn begin_at(&mut self, frames: u64, updates: u64) {
        self.after_updates = Some(updates);
        self.learner.updates = updates;
        self.is_learner_known = true;
        self.rates.add(Instant::now(), frames, updates);
        self.speed = Some(Speed::default());
    }

    /// Stores the learner's status; none if it does not answer.
    pub(crate) fn set_learner(&mut self, learner: Option<LearnerStatus>) {
        self.is_learner_answering = learner.is_some();
        if let Some(learner) = learner {
            self.learner = learner;
            self.learner_silence.record_answer();
            if !std::mem::replace(&mut self.is_learner_known, true) {
                // The learner had done its updates before this first answer, so they say nothing about its speed.
                self.rates = Rates::default();
            }
        } else {
            self.learner_silence.record_failure();
        }
        // A resumed run has the updates of its checkpoint even before its learner has answered.
        self.learner.updates = self.learner.updates.max(self.after_updates.unwrap_or(0));
    }

    /// Stores the counts of all replay servers. Call this after [`Self::set_learner`], as it also samples the updates.
    pub(crate) fn set_replay(&mut self, shards: Vec<ReplayStatus>) {
        self.replay = ReplayStatus::merged(&shards);
        self.shards = shards;
        self.replay_silence.record_answer();
        self.episodes = Episodes::new(self.replay.episodes, self.replay.returns.newest.iter());
        self.k = Spread::of_k(&self.replay);
        (self.recorded_s, self.rss_mib) = (None, Vec::new());
        let (frames, updates) = (self.replay.transitions_inserted, self.learner.updates);
        let now = Instant::now();
        self.rates.add(now, frames, updates);
        let is_known = self.speed.is_some() || now - self.rates.0[0].0 >= RATE_WINDOW;
        // After a pause, the speed before it is shown until the next sample.
        if is_known && self.rates.0.len() > 1 {
            self.speed = Some(self.rates.speed());
        }
    }

    /// The replay servers that read their replay back from disk, each with its progress.
    pub(crate) fn recovering(&self) -> impl Iterator<Item = (&ServerAnswer, RecoveryProgress)> {
        let servers = self.servers.iter();
        servers.filter_map(|it| Some((it, it.recovering?)))
    }

    pub(crate) fn servers_answered(&self) -> bool {
        self.servers.iter().all(|it| it.replay.is_some())
    }

    /// Whether all replay servers have ended; the counts are then those of their last answers.
    pub(crate) fn servers_ended(&self) -> bool {
        self.servers.iter().all(|it| it.is_gone)
    }

    /// Whether everything is learned and saved.
    pub(crate) fn is_finished(&self) -> bool {
        self.replay.learner_finished || self.learner_status().is_some() && self.is_all_learned()
    }

    /// The transitions stored and the updates made, to see whether the run stands still. A resumed run first refills its replay.
    pub(crate) fn work_done(&self) -> (u64, u64) {
        let replay = &self.replay;
        let stored = replay.transitions_inserted + replay.transitions_refilled;
        (stored, self.learner.updates)
    }

    /// Whether, by the last answers, no more rows will be sampled and the learner has saved. That the learner has saved is not
    /// enough, as a learner that was stopped early has saved too.
    pub(crate) fn is_all_learned(&self) -> bool {
        self.replay.waiting == Waiting::Finished && self.learner.finished
    }

    /// Whether everything is learned and saved, or the replay servers have ended after all rows were sampled.
    pub(crate) fn is_over(&self) -> bool {
        self.is_finished() || self.servers_ended() && self.replay.waiting == Waiting::Finished
    }

    /// Seconds since the run began, or that it took, by the clocks of its replay servers.
    pub(crate) fn uptime_s(&self) -> Option<f64> {
        let processes = self.servers.iter().filter_map(|it| it.processes.as_ref());
        let ran_s = |it: &ProcessesStatus| match it.waiting {
            Waiting::Finished => it.up_s - it.waiting_s,
            _ => it.up_s,
        };
        processes.map(ran_s).reduce(f64::max)
    }

    /// The learner's status if it answers, or its last status if no process is left to ask.
    pub(crate) fn learner_status(&self) -> Option<&LearnerStatus> {
        let is_known = self.is_learner_answering || self.is_learner_known && self.servers_ended();
        is_known.then_some(&self.learner)
    }

    /// The learner's status for the metrics. In a recorded run this is its last status, even if it does not answer any more.
    pub(crate) fn learner_shown(&self) -> Option<&LearnerStatus> {
        match self.recorded_s {
            Some(_) => self.is_learner_known.then_some(&self.learner),
            None => self.learner_status(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{config, make};
    use driml_replay_server::RatioStart;

    #[test]
    fn updates_are_those_of_the_batches_that_each_part_of_a_run_had() {
        let mut config = config("smoke", "chain", "c51", &["learner.batch_size=32"]);
        assert_eq!(updates_served(&config, 96_000), 3_000);
        config.replay.since = Some(RatioStart {
            transitions: 9_000,
            rows: 64_000,
            updates: 1_000,
        });
        for (rows, updates) in [(64_000, 1_000), (96_000, 2_000), (96_031, 2_000)] {
            assert_eq!(updates_served(&config, rows), updates);
        }
    }

    #[test]
    fn a_run_that_refills_its_replay_does_not_stand_still() {
        let done = |refilled| {
            let mut view = RunView::new(Plan::default());
            view.set_replay(vec![make(|it: &mut ReplayStatus| {
                (it.transitions_inserted, it.transitions_refilled) = (9_000, refilled);
            })]);
            view.work_done()
        };
        assert_eq!([done(0), done(7)], [(9_000, 0), (9_007, 0)]);
    }

    #[test]
    fn a_learner_that_ended_before_all_is_sampled_has_not_learned_it() {
        let mut view = RunView::new(Plan::default());
        view.set_learner(Some(make(|it: &mut LearnerStatus| it.finished = true)));
        for (waiting, is_all_learned) in [(Waiting::Neither, false), (Waiting::Finished, true)] {
            view.set_replay(vec![make(|it: &mut ReplayStatus| {
                (it.finished, it.waiting) = (true, waiting);
            })]);
            let found = (view.is_all_learned(), view.is_finished());
            assert_eq!(found, (is_all_learned, is_all_learned), "{waiting}");
        }
    }

    #[test]
    fn updates_before_the_learner_s_first_answer_are_not_its_speed() {
        let learner = |updates| make(|it: &mut LearnerStatus| it.updates = updates);
        let mut view = RunView::new(Plan::default());
        for answer in [None, Some(learner(5_000)), Some(learner(5_000))] {
            view.set_learner(answer);
            view.set_replay(vec![ReplayStatus::default()]);
        }
        assert_eq!(view.rates.speed().updates, 0.0);
        assert_eq!(view.speed, None, "counts arrive in lumps");
        let begun = Instant::now().checked_sub(RATE_WINDOW).unwrap();
        let sample = |at| (at, 0, 5_000);
        view.rates = Rates([begun, begun + RATE_WINDOW / 2].map(sample).into());
        view.set_replay(vec![ReplayStatus::default()]);
        assert_eq!(view.speed, Some(Speed::default()));

        let mut resumed = RunView::new(Plan::default());
        resumed.begin_at(0, 70);
        resumed.set_learner(None);
        assert_eq!(resumed.learner.updates, 70, "before it has answered");
        assert!(resumed.speed.is_some(), "the launcher saw the run begin");
    }

    fn rates(samples: impl IntoIterator<Item = (u64, u64, u64)>) -> Rates {
        let (mut rates, start) = (Rates::default(), Instant::now());
        for (second, frames, updates) in samples {
            rates.add(start + Duration::from_secs(second), frames, updates);
        }
        rates
    }

    #[test]
    fn rates_forget_what_is_long_ago_and_a_warm_up_does_not_dilute_them() {
        assert_eq!(rates([]).speed(), Speed::default());
        let frames_after_50_s = |second: u64| (second, second.saturating_sub(50) * 10, 0);
        let long = rates((0..100).map(frames_after_50_s));
        assert_eq!(long.speed().frames, 10.0);
        assert!(long.0.len() <= 22);
        let warmed_up = rates([(0, 0, 7), (10, 10, 7), (12, 12, 47)]).speed();
        assert_eq!((warmed_up.frames, warmed_up.updates), (1.0, 20.0));
        let mut lump = rates([(0, 0, 0)]);
        lump.add(lump.0[0].0 + Duration::from_millis(1), 256, 9);
        assert_eq!(lump.speed(), Speed::default(), "too soon to tell");
        let paused = [(0, 0, 0), (1, 10, 1), (5_000, 20, 2), (5_001, 50, 8)];
        let [at_once, later] = [3, 4].map(|samples| rates(paused[..samples].to_vec()).speed());
        let speeds = (at_once.frames, later.frames, later.updates);
        assert_eq!(speeds, (0.0, 30.0, 6.0));
    }
}
