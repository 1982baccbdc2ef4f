//! Layout and texts of one filmed environment in a picture: its enlarged frame, and beside it the network's outputs.
//! This file does not call the network; it receives the outputs.

use driml_figure::{Ink, Picture, Rect};
use driml_learner::insight::NetworkOutputs;
use driml_settings::config::RunConfig;

/// The approximate length of an enlarged frame's longer side, in pixels. The zoom is a whole number.
const FRAME_SIDE: usize = 224;
const MARGIN: f64 = 10.0;
const PANEL_WIDTH: f64 = 216.0;
const PANEL_HEIGHT: f64 = 230.0;
/// The distance between lines of text, in pixels.
const LEADING: f64 = 19.0;

#[derive(Clone, Debug, Default)]
pub(super) struct Shot {
    /// The newest frame [H, W, C] in which the action was taken.
    pub(super) frame: Vec<u8>,
    /// The number of the episode, from 1.
    pub(super) episode: u32,
    pub(super) step: u32,
    /// The episode's return up to this step's reward.
    pub(super) total: f64,
    pub(super) reward: f64,
    pub(super) action: u8,
    pub(super) is_last: bool,
    /// `None` if the network is not asked.
    pub(super) outputs: Option<ActionOutputs>,
}

/// The outputs of the network for a state and the action taken there.
#[derive(Clone, Debug)]
pub(super) struct ActionOutputs {
    /// Q-values [A].
    q_values: Vec<f32>,
    /// The return distribution [N] of the action that was taken.
    probabilities: Vec<f32>,
}

/// The question to local DIM: which locations of a later state it recognises.
#[derive(Debug)]
pub(super) struct Local {
    /// Steps from a state to the later one: the fixed k, or 1, the smallest k of the rules that draw it.
    pub(super) k: usize,
    pub(super) rows: usize,
    pub(super) columns: usize,
    /// The number of states among which local DIM chooses: those of all environments that are played.
    pub(super) candidates: usize,
}

#[derive(Debug)]
pub(super) struct Layout {
    /// The shape [H, W, C] of a frame.
    frame: [usize; 3],
    zoom: usize,
    /// Width and height of an enlarged frame, and of the whole tile of an environment, in pixels.
    enlarged: (f64, f64),
    tile: (f64, f64),
    columns: usize,
    /// Width and height of a picture, in pixels.
    pub(super) size: (usize, usize),
    /// `None` if the agent has no such loss, or there are no other states to choose among.
    pub(super) local: Option<Local>,
    action_names: Vec<String>,
    support: Vec<f32>,
}

impl Layout {
    pub(super) fn new(
        config: &RunConfig,
        envs: usize,
        has_panel: bool,
        local: Option<Local>,
    ) -> Self {
        let spec = &config.run;
        let (height, width) = spec.frame_size();
        let longer = height.max(width).max(1);
        let zoom = ((FRAME_SIDE + longer / 2) / longer).max(1);
        let enlarged = ((width * zoom) as f64, (height * zoom) as f64);
        let mut tile = enlarged;
        // Without panels, up to four tiles stand side by side; with panels, up to four stand below each other.
        let mut columns = envs.clamp(1, 4);
        if has_panel {
            tile.0 += MARGIN + PANEL_WIDTH;
            columns = envs.div_ceil(4).max(1);
        }
        if local.is_some() {
            tile = (tile.0 + MARGIN + enlarged.0, tile.1 + LEADING);
        }
        if has_panel {
            tile.1 = tile.1.max(PANEL_HEIGHT);
        }
        let along = |count: usize, side: f64| MARGIN + count as f64 * (side + MARGIN);
        let across = along(columns, tile.0) as usize;
        Self {
            frame: [height, width, spec.frame_channels as usize],
            zoom,
            enlarged,
            tile,
            columns,
            size: (across, along(envs.div_ceil(columns), tile.1) as usize),
            local,
            action_names: config.action_names(),
            support: config.model.atoms_support(),
        }
    }

    /// Returns the outputs in `seen` for environment `i`, in which `action` was taken.
    pub(super) fn outputs_of(&self, seen: &NetworkOutputs, i: usize, action: u8) -> ActionOutputs {
        let (actions, atoms) = (self.action_names.len(), self.support.len());
        let taken = i * actions + usize::from(action);
        ActionOutputs {
            q_values: row_of(&seen.q_values, actions, i).to_vec(),
            probabilities: row_of(&seen.probabilities, atoms, taken).to_vec(),
        }
    }

    /// Draws the shot of environment `i`. `matches` are the probabilities [B, L] with which local DIM recognises each location of the later
    /// states; `None` if it was not asked.
    pub(super) fn draw(
        &self,
        picture: &mut Picture,
        i: usize,
        shot: &Shot,
        matches: Option<&[f64]>,
    ) {
        let (tile_width, tile_height) = self.tile;
        let (column, row) = (i % self.columns, i / self.columns);
        let x = MARGIN + column as f64 * (tile_width + MARGIN);
        let y = MARGIN + row as f64 * (tile_height + MARGIN);
        picture.image((x as usize, y as usize), self.zoom, &shot.frame, self.frame);
        let Some(outputs) = &shot.outputs else { return };
        let (frame_width, frame_height) = self.enlarged;
        let panel = Rect::new(x + frame_width + MARGIN, y, PANEL_WIDTH, tile_height);
        self.draw_panel(picture, panel, shot, outputs);
        if let Some(local) = &self.local {
            let x = panel.x + PANEL_WIDTH + MARGIN;
            let map = Rect::new(x, y, frame_width, frame_height);
            let locations = local.rows * local.columns;
            let unknown = vec![f64::NAN; locations];
            let matches = matches.map_or(&unknown[..], |all| row_of(all, locations, i));
            picture.cells(map, local.columns, matches);
            let words = format!("local DIM, k = {}, chance 1/{}", local.k, local.candidates);
            let below = (x, y + frame_height + LEADING - 4.0);
            picture.text(below, frame_width, Ink::Soft, &words);
        }
    }

    fn draw_panel(&self, picture: &mut Picture, area: Rect, shot: &Shot, outputs: &ActionOutputs) {
        let action = usize::from(shot.action);
        let (q, name) = (outputs.q_values[action], &self.action_names[action]);
        let q_values = outputs.q_values.iter().copied();
        let best = q_values.fold(f32::NEG_INFINITY, f32::max);
        let chance = if q < best { " (by chance)" } else { "" };
        let time = format!("episode {}, step {}", shot.episode, shot.step);
        let rewards = format!("return {:.2} ({:+.2})", shot.total, shot.reward);
        let mut y = area.y + 13.0;
        for (ink, text) in [
            (Ink::Soft, time),
            (Ink::Plain, rewards),
            (Ink::Plain, format!("value {best:.3}")),
            (Ink::Bold, format!("{name}{chance}")),
        ] {
            picture.text((area.x, y), area.width, ink, &text);
            y += LEADING;
        }
        let top = y - 5.0;
        let bottom = area.y + area.height - LEADING;
        let bars = Rect::new(area.x, top, area.width, bottom - top);
        let probabilities = outputs.probabilities.iter();
        let most = probabilities.clone().copied();
        let most = most.fold(f32::MIN_POSITIVE, f32::max);
        let heights: Vec<_> = probabilities.map(|p| f64::from(p / most)).collect();
        let (low, high) = (self.support[0], self.support[self.support.len() - 1]);
        picture.bars(bars, &heights, f64::from((q - low) / (high - low)));
        let words = format!("its return, {low} to {high}: {q:.3}");
        let below = (area.x, area.y + area.height - 4.0);
        picture.text(below, area.width, Ink::Soft, &words);
    }
}

fn row_of<T>(rows: &[T], length: usize, index: usize) -> &[T] {
    &rows[index * length..][..length]
}
