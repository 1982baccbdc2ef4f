//! A film of what the agent plays: which environments, for how long, and what stands beside each frame.
//! Filming does not change what is played.

use std::{
    collections::VecDeque,
    fs::File,
    io::{self, BufWriter},
    path::PathBuf,
};

use anyhow::Context;
use clap::Args;
use driml_actor::Step;
use driml_envs::StepEnd;
use driml_figure::{Film, Picture};
use driml_launch::{evaluate::Player, output::unwritable};
use driml_learner::insight::{Insight, NetworkOutputs};
use driml_machine::whole_number;
use driml_protocol::Horizon;
use tempfile::TempPath;

use super::tile::{Layout, Local, Shot};

/// How many times longer than others the last picture of an episode is shown, if one environment is filmed.
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
    #[arg(long, value_name = "N", default_value_t = 1, requires = "record", value_parser = whole_number::within_u32(1..=8))]
    pub(crate) record_envs: u32,
    /// Episodes to film per environment; fewer if fewer are played
    #[arg(long, value_name = "N", default_value_t = 2, requires = "record", value_parser = whole_number::within_u32(1..=1000))]
    pub(crate) record_episodes: u32,
    /// Steps to film at most; a Procgen frame takes 5 to 10 kB
    #[arg(long, value_name = "N", default_value_t = 600, requires = "record", value_parser = whole_number::within_u32(1..=10_000))]
    pub(crate) record_steps: u32,
}

impl RecordArgs {
    /// The path of the unfinished film, if there is to be one.
    pub(crate) fn tmp_path(&self) -> Option<PathBuf> {
        let mut path = self.record.clone()?.into_os_string();
        path.push(".tmp");
        Some(path.into())
    }
}

pub(crate) struct Recording {
    path: PathBuf,
    /// The file of an unfinished film: dropping it removes it. `finish` renames it to `path`, where an older file stays until then.
    tmp_path: TempPath,
    film: Film<BufWriter<File>>,
    layout: Layout,
    /// Computes the network's outputs for the states, if they are shown.
    insight: Option<Insight>,
    /// The newest shot of each environment. The last one stays once all episodes of the environment are filmed.
    shots: Vec<Shot>,
    episodes_max: u32,
    steps_max: u32,
    steps: u32,
    /// Steps that are not drawn yet, because local DIM compares them with later states.
    waiting: VecDeque<FilmedStep>,
}

struct FilmedStep {
    shots: Vec<Shot>,
    seen: Option<NetworkOutputs>,
    actions: Vec<u8>,
    ends: Vec<StepEnd>,
}

impl Recording {
    /// Begins the film of an evaluation of `episodes` episodes, if the flags ask for one. Dropping an unfinished film leaves no file.
    pub(crate) fn begin(
        args: &RecordArgs,
        player: &Player,
        episodes: u32,
    ) -> anyhow::Result<Option<Self>> {
        let (Some(path), Some(tmp_path)) = (&args.record, args.tmp_path()) else {
            return Ok(None);
        };
        let played = Player::envs(episodes as usize);
        let envs = (args.record_envs as usize).min(played);
        let insight = args.overlay.then(|| player.insight()).transpose()?;
        let k = match player.config.run.horizon {
            Horizon::Fixed { k } => k as usize,
            _ => 1,
        };
        let shape = insight.as_ref().and_then(Insight::f3_shape);
        let local = shape.filter(|_| played > 1).map(|(rows, columns)| Local {
            k,
            rows,
            columns,
            candidates: played,
        });
        let layout = Layout::new(&player.config, envs, insight.is_some(), local);
        let rate = player.config.world.steps_per_second();
        let begin = || -> io::Result<_> {
            let file = BufWriter::new(File::create(&tmp_path)?);
            let tmp_path = TempPath::try_from_path(tmp_path)?;
            Ok((tmp_path, Film::begin(file, layout.size, rate)?))
        };
        let (tmp_path, film) = begin().map_err(|e| unwritable("--record", path, e))?;
        // Start as if an episode had ended before the first.
        let before = Shot {
            is_last: true,
            ..Shot::default()
        };
        Ok(Some(Self {
            path: path.clone(),
            tmp_path,
            film,
            layout,
            insight,
            shots: vec![before; envs],
            episodes_max: args.record_episodes,
            steps_max: args.record_steps,
            steps: 0,
            waiting: VecDeque::new(),
        }))
    }

    /// Films a step, unless everything is filmed.
    pub(crate) fn add_step(&mut self, step: &Step<'_>) -> anyhow::Result<()> {
        let is_over = |shot: &Shot| shot.is_over(self.episodes_max);
        if self.steps == self.steps_max || self.shots.iter().all(is_over) {
            return Ok(());
        }
        let played = step.actions.len();
        let frames = step.frames.chunks_exact(step.frames.len() / played);
        let mut seen = None;
        if let Some(insight) = &self.insight {
            // Local DIM tells a state from those of all environments, not only of the filmed ones.
            let num_states = match self.layout.local {
                Some(_) => played,
                None => self.shots.len(),
            };
            let states = &step.states[..step.states.len() / played * num_states];
            seen = Some(insight.evaluate(states)?);
        }
        for (i, (shot, frame)) in self.shots.iter_mut().zip(frames).enumerate() {
            if !shot.is_over(self.episodes_max) {
                shot.advance(frame, step, i);
                let outputs = |seen| self.layout.outputs_of(seen, i, shot.action);
                shot.outputs = seen.as_ref().map(outputs);
            }
        }
        self.waiting.push_back(FilmedStep {
            shots: self.shots.clone(),
            seen,
            actions: step.actions.to_vec(),
            ends: step.ends.to_vec(),
        });
        self.steps += 1;
        if self.waiting.len() > self.steps_ahead() {
            self.draw_next()?;
        }
        Ok(())
    }

    /// Returns the number of steps from a state to the later state that local DIM is asked about; 0 without local DIM.
    fn steps_ahead(&self) -> usize {
        self.layout.local.as_ref().map_or(0, |it| it.k)
    }

    /// Draws the oldest waiting step, with local DIM's result for the state [`Self::steps_ahead`] of it if that was played.
    fn draw_next(&mut self) -> anyhow::Result<()> {
        let Some(filmed) = self.waiting.pop_front() else {
            return Ok(());
        };
        let between = self.steps_ahead().saturating_sub(1);
        let later = self.waiting.get(between).and_then(|it| it.seen.as_ref());
        let matches = match (&self.insight, &filmed.seen, later) {
            (Some(insight), Some(now), Some(later)) => {
                insight.local_matches(now, &filmed.actions, later)?
            }
            _ => None,
        };
        let (width, height) = self.layout.size;
        let mut picture = Picture::new(width, height)?;
        for (i, shot) in filmed.shots.iter().enumerate() {
            // If the episode ends between a state and the later one, local DIM has nothing to recognise.
            let mut before = self.waiting.iter().take(between).chain([&filmed]);
            let continues = !shot.is_last && before.all(|it| it.ends[i] == StepEnd::Running);
            let matches = matches.as_deref().filter(|_| continues);
            self.layout.draw(&mut picture, i, shot, matches);
        }
        let ended = matches!(filmed.shots[..], [Shot { is_last: true, .. }]);
        let added = self.film.add(&picture, if ended { PAUSE } else { 1.0 });
        Ok(added.map_err(|e| unwritable("--record", &self.path, e))?)
    }

    /// Ends the film, and returns a sentence about its content.
    pub(crate) fn finish(mut self) -> anyhow::Result<String> {
        while !self.waiting.is_empty() {
            self.draw_next().context("making the film")?;
        }
        let file = self.film.finish();
        let written = file.and_then(|_| Ok(self.tmp_path.persist(&self.path)?));
        written.map_err(|e| unwritable("--record", &self.path, e))?;
        let steps = driml_machine::units::count(self.steps, "step");
        Ok(format!("filmed {steps}: {}\n", self.path.display()))
    }
}

impl Shot {
    fn is_over(&self, episodes_max: u32) -> bool {
        self.is_last && self.episode == episodes_max
    }

    /// Updates this shot with the next step of its environment `i`.
    fn advance(&mut self, frame: &[u8], step: &Step<'_>, i: usize) {
        if self.is_last {
            (self.episode, self.step, self.total) = (self.episode + 1, 0, 0.0);
        } else {
            self.step += 1;
        }
        self.frame = frame.to_vec();
        self.action = step.actions[i];
        self.reward = f64::from(step.rewards[i]);
        self.total += self.reward;
        self.is_last = matches!(step.ends[i], StepEnd::Terminal | StepEnd::TimedOut);
    }
}
