//! A run as its processes describe it: their last answers, and how long ago each came.
//! It asks no process: the poller and the lockstep mode feed it.

use std::time::Instant;

use driml_actor::Schedule;
use driml_protocol::{LearnerStatus, PartsStatus, RecoveryProgress, ReplayStatus, Waiting};
use driml_settings::config::RunConfig;
use serde::Serialize;

use crate::moment::{Episodes, Moment, Rates, Spread};

/// What the settings say of a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Plan {
    /// The world, as `--env` names it.
    pub world: String,
    /// The agent, as `--agent` names it.
    pub agent: String,
    /// The seed of every generator of the run.
    pub seed: u64,
    /// What all processes of the run agree on, as a hash: the same number is the same run.
    pub run_spec: String,
    /// Frames of the whole run.
    pub frames_planned: u64,
    /// Updates of the whole run.
    pub updates_planned: u64,
    /// Rows an update and a transition.
    pub replay_ratio_planned: f64,
    /// Actors that the settings name.
    pub actors_planned: u32,
    /// The probability with which all actors act at random; none where they differ in it.
    #[serde(skip)]
    pub epsilon: Option<Schedule>,
}

impl Plan {
    /// Of a run with these settings.
    pub fn of(config: &RunConfig) -> Self {
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
            // Without a ladder it is every actor's.
            epsilon: Schedule::new(&config.actor, 0).ok().filter(|_| is_common),
        }
    }
}

/// What one replay server answers.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ServerAnswer {
    /// What it is called in messages.
    #[serde(skip)]
    pub name: String,
    /// Where it was asked.
    pub endpoint: String,
    /// Its counts; none if it does not answer, or not yet.
    pub replay: Option<ReplayStatus>,
    /// Who takes part; none if it does not answer, or not yet.
    pub parts: Option<PartsStatus>,
    /// How far it is with reading its replay back from disk, before which it can answer nothing else.
    pub recovering: Option<RecoveryProgress>,
    /// Why there is no answer.
    pub error: Option<String>,
    /// Nothing listens there any more: its process has ended.
    pub is_gone: bool,
    /// It answers, and for a run with other settings.
    pub is_another_run: bool,
}

/// What is known of a run.
#[derive(Clone, Debug)]
pub struct RunView {
    /// What its settings say.
    pub plan: Plan,
    /// Updates after which it was resumed; none before that is known.
    pub after_updates: Option<u64>,
    /// What each replay server answered last time.
    pub servers: Vec<ServerAnswer>,
    /// The replay servers' counts when all of them answered last.
    pub shards: Vec<ReplayStatus>,
    /// The same, as of one.
    pub replay: ReplayStatus,
    /// The learner's last status.
    pub learner: LearnerStatus,
    /// Whether the learner answered last time.
    pub learner_answers: bool,
    /// When all replay servers answered last, and when the learner did; at first, when this was made.
    pub(crate) replay_last_seen: Instant,
    pub(crate) learner_last_seen: Instant,
    /// Whether the learner has answered ever, or the counts at the start are known without it.
    is_learner_known: bool,
    rates: Rates,
}

impl RunView {
    /// The view of a run without any report yet.
    pub fn new(plan: Plan) -> Self {
        let now = Instant::now();
        Self {
            plan,
            after_updates: None,
            servers: Vec::new(),
            shards: Vec::new(),
            replay: ReplayStatus::default(),
            learner: LearnerStatus::default(),
            learner_answers: false,
            replay_last_seen: now,
            learner_last_seen: now,
            is_learner_known: false,
            rates: Rates::default(),
        }
    }

    /// Of a run that begins now, with these counts.
    pub fn beginning(plan: Plan, frames: u64, updates: u64) -> Self {
        let mut this = Self::new(plan);
        this.after_updates = Some(updates);
        this.learner.updates = updates;
        this.is_learner_known = true;
        this.rates.add(this.replay_last_seen, frames, updates);
        this
    }

    /// Takes the learner's status; none if it does not answer.
    pub fn take_learner(&mut self, learner: Option<LearnerStatus>) {
        self.learner_answers = learner.is_some();
        if let Some(learner) = learner {
            self.learner = learner;
            self.learner_last_seen = Instant::now();
            if !std::mem::replace(&mut self.is_learner_known, true) {
                // Its updates did not come at once.
                self.rates = Rates::default();
            }
        }
        // Until the learner of a resumed run has answered, too.
        let before = self.after_updates.unwrap_or(0);
        self.learner.updates = self.learner.updates.max(before);
    }

    /// Takes the counts of all replay servers, after the learner's.
    pub fn take_replay(&mut self, shards: Vec<ReplayStatus>) {
        self.replay = ReplayStatus::merged(&shards);
        self.shards = shards;
        self.replay_last_seen = Instant::now();
        let frames = self.replay.transitions_inserted;
        self.rates
            .add(self.replay_last_seen, frames, self.learner.updates);
    }

    /// Each replay server that reads its replay back from disk, and how far it is.
    pub(crate) fn recovering(&self) -> impl Iterator<Item = (&ServerAnswer, RecoveryProgress)> {
        let servers = self.servers.iter();
        servers.filter_map(|it| Some((it, it.recovering?)))
    }

    /// Whether all replay servers answered last time.
    pub fn is_answered(&self) -> bool {
        self.servers.iter().all(|it| it.replay.is_some())
    }

    /// Whether all replay servers have ended; the counts are then those of their last answers.
    pub(crate) fn is_gone(&self) -> bool {
        self.servers.iter().all(|it| it.is_gone)
    }

    /// Whether everything is learned and saved.
    pub fn is_finished(&self) -> bool {
        let learner = self.learner_status();
        self.replay.learner_finished
            || self.replay.finished && learner.is_some_and(|it| it.finished)
    }

    /// Whether everything is learned and saved, or the replay servers have ended after everything was sampled.
    pub fn is_over(&self) -> bool {
        self.is_finished() || self.is_gone() && self.replay.waiting == Waiting::Finished
    }

    /// Seconds since the run began, by its replay servers.
    pub(crate) fn up_s(&self) -> Option<f64> {
        let parts = self.servers.iter().filter_map(|it| it.parts.as_ref());
        parts.map(|it| it.up_s).reduce(f64::max)
    }

    /// The learner's status: its answer, or its last one where no process is left to be asked.
    pub(crate) fn learner_status(&self) -> Option<&LearnerStatus> {
        let is_known = self.learner_answers || self.is_learner_known && self.is_gone();
        is_known.then_some(&self.learner)
    }

    /// What it says of the run at this time.
    pub fn moment(&self) -> Moment<'_> {
        let replay = &self.replay;
        let losses = self.learner.losses.iter();
        Moment {
            seconds: self.up_s(),
            speed: self.rates.speed(),
            episodes: Episodes::of(replay.episodes, replay.returns.newest.iter()),
            k: (replay.mean_k().zip(replay.sd_k())).map(|(mean, sd)| Spread { mean, sd }),
            epsilon: (self.plan.epsilon).map(|it| it.epsilon(replay.transitions_inserted)),
            replay,
            learner: self.learner_status(),
            losses: losses.map(|(name, _)| name.as_str()).collect(),
            rss_mib: Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::with;

    #[test]
    fn updates_before_the_learner_s_first_answer_are_not_its_speed() {
        let learner = |updates| with(|it: &mut LearnerStatus| it.updates = updates);
        let mut view = RunView::new(Plan::default());
        for answer in [None, Some(learner(5_000)), Some(learner(5_000))] {
            view.take_learner(answer);
            view.take_replay(vec![ReplayStatus::default()]);
        }
        assert_eq!(view.moment().speed.updates, 0.0);

        let mut resumed = RunView::beginning(Plan::default(), 0, 70);
        resumed.take_learner(None);
        assert_eq!(resumed.learner.updates, 70, "before it has answered");
    }
}
