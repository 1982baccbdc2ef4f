//! A film of what the agent plays: which environments, for how long, and what stands beside each frame.
//! It watches: nothing that is played depends on it.

use std::{collections::VecDeque, path::PathBuf};

use anyhow::Context;
use clap::Args;
use driml_actor::Step;
use driml_envs::StepEnd;
use driml_figure::{FigureError, Film, Picture};
use driml_launch::evaluate::{Player, Viewer};
use driml_learner::insight::Seen;
use driml_machine::error::{Usage, usage};
use driml_protocol::Horizon;

use super::tile::{Layout, Look, Shot};

/// Times as long as others that the last picture of an episode is shown, where one environment is.
const PAUSE: f64 = 8.0;

#[derive(Debug, Args)]
pub(crate) struct RecordArgs {
    /// Film the agent, as an animated GIF at the game's speed
    #[arg(long, value_name = "FILE.gif")]
    pub(crate) record: Option<PathBuf>,
    /// Show beside each frame the value, C51's distribution, the action and the scores of local DIM
    #[arg(long, requires = "record")]
    pub(crate) overlay: bool,
    /// Environments to film, side by side
    #[arg(long, alias = "record-copies", value_name = "N", default_value_t = 1, requires = "record", value_parser = clap::value_parser!(u32).range(1..=8))]
    pub(crate) record_envs: u32,
    /// Episodes to film per environment; fewer if fewer are played
    #[arg(long, value_name = "N", default_value_t = 2, requires = "record", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) record_episodes: u32,
    /// Steps to film at most; a Procgen frame takes 5 to 10 kB
    #[arg(long, value_name = "N", default_value_t = 600, requires = "record", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub(crate) record_steps: u32,
}

pub(crate) struct Recording {
    path: PathBuf,
    film: Film,
    layout: Layout,
    overlay: Option<Overlay>,
    envs: Vec<Filmed>,
    episodes_max: u32,
    steps_max: u32,
    steps: u32,
    /// Steps that are not drawn yet, as local DIM is asked what came after them.
    waiting: VecDeque<Moment>,
    failed: Option<anyhow::Error>,
}

/// What the network is asked.
struct Overlay {
    viewer: Viewer,
    /// Steps from a state to the one that local DIM is to know; none where the agent has no such loss, or there is nothing to tell it from.
    local_k: Option<usize>,
}

#[derive(Clone, Default)]
struct Filmed {
    episode: u32,
    step: u32,
    total: f64,
    /// Its last shot, once all its episodes are filmed.
    over: Option<Shot>,
}

/// One step of all environments.
struct Moment {
    shots: Vec<Shot>,
    seen: Option<Seen>,
    actions: Vec<u8>,
    ends: Vec<StepEnd>,
}

impl Recording {
    /// Begins the film of an evaluation of so many episodes, if one is asked for.
    pub(crate) fn begin(
        args: &RecordArgs,
        player: &Player,
        episodes: u32,
    ) -> anyhow::Result<Option<Self>> {
        let Some(path) = &args.record else {
            return Ok(None);
        };
        let played = Player::envs(episodes as usize);
        let envs = (args.record_envs as usize).min(played);
        let viewer = args.overlay.then(|| player.viewer()).transpose()?;
        let overlay = viewer.map(|viewer| {
            let ahead = match player.config.run.horizon {
                Horizon::Fixed { k } => k as usize,
                _ => 1,
            };
            let is_local = viewer.insight.local_shape().is_some() && played > 1;
            let local_k = is_local.then_some(ahead);
            Overlay { viewer, local_k }
        });
        let shown = overlay.as_ref();
        let local = shown.and_then(|it| it.local_k.zip(it.viewer.insight.local_shape()));
        let layout = Layout::new(&player.config, envs, overlay.is_some(), local, played);
        let rate = player.config.world.steps_per_second();
        let film = Film::create(path, layout.size(), rate).map_err(cannot)?;
        Ok(Some(Self {
            path: path.clone(),
            film,
            layout,
            overlay,
            envs: vec![Filmed::default(); envs],
            episodes_max: args.record_episodes,
            steps_max: args.record_steps,
            steps: 0,
            waiting: VecDeque::new(),
            failed: None,
        }))
    }

    fn is_over(&self) -> bool {
        self.failed.is_some()
            || self.steps >= self.steps_max
            || self.envs.iter().all(|env| env.over.is_some())
    }

    /// Films a step. [`finish`](Self::finish) returns the errors.
    pub(crate) fn see(&mut self, step: &Step<'_>) {
        if !self.is_over()
            && let Err(e) = self.add(step)
        {
            self.failed = Some(e);
        }
    }

    fn add(&mut self, step: &Step<'_>) -> anyhow::Result<()> {
        let played = step.actions.len();
        let frame_bytes = step.frames.len() / played;
        let mut shots = Vec::with_capacity(self.envs.len());
        for (i, env) in self.envs.iter_mut().enumerate() {
            let frame = &step.frames[i * frame_bytes..][..frame_bytes];
            shots.push(env.take(frame, step, i, self.episodes_max));
        }
        let (mut seen, mut ahead) = (None, 0);
        if let Some(Overlay { viewer, local_k }) = &mut self.overlay {
            // Other environments than the filmed are what local DIM tells a state from.
            let looked_at = local_k.map_or(self.envs.len(), |_| played);
            let states = &step.states[..step.states.len() / played * looked_at];
            seen = Some(viewer.look(states)?);
            ahead = local_k.unwrap_or(0);
        }
        self.waiting.push_back(Moment {
            shots,
            seen,
            actions: step.actions.to_vec(),
            ends: step.ends.to_vec(),
        });
        self.steps += 1;
        if self.waiting.len() > ahead {
            self.draw_next(ahead)?;
        }
        Ok(())
    }

    /// Draws the step that waits longest, with what local DIM says of the one `ahead` of it.
    fn draw_next(&mut self, ahead: usize) -> anyhow::Result<()> {
        let Some(moment) = self.waiting.pop_front() else {
            return Ok(());
        };
        let mut matches = None;
        if let Some(overlay) = &self.overlay
            && overlay.local_k == Some(ahead)
            && let Some(later) = self.waiting.get(ahead - 1).and_then(|it| it.seen.as_ref())
            && let Some(now) = &moment.seen
        {
            let insight = &overlay.viewer.insight;
            matches = insight.local_matches(now, &moment.actions, later)?;
        }
        let (width, height) = self.layout.size();
        let mut picture = Picture::new(width, height)?;
        for (i, shot) in moment.shots.iter().enumerate() {
            // The end of an episode lies between a state and the one looked for: there is nothing to know.
            let between = self.waiting.iter().take(ahead.saturating_sub(1));
            let between = between.filter_map(|it| it.ends.get(i));
            let mut ends = between.chain(moment.ends.get(i));
            let continues = ends.all(|end| *end == StepEnd::Running);
            let look = moment.seen.as_ref().map(|seen| Look {
                q_values: row(&seen.q_values, self.layout.actions(), i),
                probabilities: row(&seen.probabilities, self.layout.logits(), i),
                matches: matches
                    .as_deref()
                    .filter(|_| continues)
                    .map(|all| row(all, self.layout.locations(), i)),
            });
            self.layout.draw(&mut picture, i, shot, look);
        }
        let ended = matches!(moment.shots[..], [Shot { is_last: true, .. }]);
        self.film.add(&picture, if ended { PAUSE } else { 1.0 })?;
        Ok(())
    }

    /// Ends the film, and says what it shows.
    pub(crate) fn finish(mut self) -> anyhow::Result<String> {
        while self.failed.is_none() && !self.waiting.is_empty() {
            self.failed = self.draw_next(0).err();
        }
        let doing = || format!("filming to {}", self.path.display());
        if let Some(e) = self.failed.take() {
            let e = e.context(doing());
            self.film.discard();
            return Err(e);
        }
        self.film.finish().with_context(doing)?;
        let steps = self.steps;
        Ok(format!("filmed {steps} steps: {}\n", self.path.display()))
    }

    pub(crate) fn discard(self) {
        self.film.discard();
    }
}

impl Filmed {
    /// What is shown of environment `i` in this step.
    fn take(&mut self, frame: &[u8], step: &Step<'_>, i: usize, episodes_max: u32) -> Shot {
        if let Some(shot) = &self.over {
            return Shot {
                is_last: false,
                ..shot.clone()
            };
        }
        let reward = f64::from(step.rewards[i]);
        self.total += reward;
        let is_last = matches!(step.ends[i], StepEnd::Terminal | StepEnd::TimedOut);
        let shot = Shot {
            frame: frame.to_vec(),
            episode: self.episode + 1,
            step: self.step,
            total: self.total,
            reward,
            action: step.actions[i],
            is_last,
        };
        self.step += 1;
        if is_last {
            (self.episode, self.step, self.total) = (self.episode + 1, 0, 0.0);
            self.over = (self.episode == episodes_max).then(|| shot.clone());
        }
        shot
    }
}

fn row<T>(all: &[T], length: usize, index: usize) -> &[T] {
    &all[index * length..][..length]
}

/// A film that cannot be begun is a flag that cannot work.
fn cannot(error: FigureError) -> Usage {
    match &error {
        FigureError::Write { path, source } => {
            let path = path.display();
            usage!("--record {path}: {source}: choose another place")
        }
        _ => usage!("--record: {error}"),
    }
}
