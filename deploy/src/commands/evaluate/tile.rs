//! One filmed environment in a picture: its frame, enlarged, and beside it what the network makes of it. Where things stand, and their words.
//! It asks no network: it is told.

use driml_figure::{Area, Image, Ink, Picture};
use driml_settings::config::RunConfig;

/// Pixels that the longer side of a frame is enlarged to, or nearly: each pixel becomes a square of whole pixels.
const FRAME_SIDE: usize = 224;
/// Pixels around and between what is shown.
const MARGIN: usize = 10;
/// Pixels across of the words and bars.
const PANEL_WIDTH: usize = 216;
/// Pixels down of the words and bars at least.
const PANEL_HEIGHT: usize = 230;
/// Pixels from line to line.
const LEADING: usize = 19;

#[derive(Clone, Debug)]
pub(super) struct Shot {
    /// The newest frame [H, W, C] in which the action was taken.
    pub(super) frame: Vec<u8>,
    pub(super) episode: u32,
    pub(super) step: u32,
    /// The episode's return up to this step's reward.
    pub(super) total: f64,
    pub(super) reward: f64,
    pub(super) action: u8,
    pub(super) is_last: bool,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Look<'a> {
    /// [A].
    pub(super) q_values: &'a [f32],
    /// [A, N].
    pub(super) probabilities: &'a [f32],
    /// [L]: how surely local DIM knows each location of the later state; none where it was not asked.
    pub(super) matches: Option<&'a [f64]>,
}

#[derive(Debug)]
pub(super) struct Layout {
    frame: (usize, usize, usize),
    zoom: usize,
    envs: usize,
    has_panel: bool,
    local: Option<Local>,
    action_names: Vec<String>,
    support: Vec<f32>,
}

#[derive(Debug)]
struct Local {
    k: usize,
    rows: usize,
    columns: usize,
    candidates: usize,
}

impl Layout {
    /// Of `envs` filmed out of `candidates` environments played; `local` is k and the shape of the local features, if they are asked.
    pub(super) fn new(
        config: &RunConfig,
        envs: usize,
        has_panel: bool,
        local: Option<(usize, (usize, usize))>,
        candidates: usize,
    ) -> Self {
        let spec = &config.run;
        let (height, width) = (spec.frame_height as usize, spec.frame_width as usize);
        let longer = height.max(width).max(1);
        Self {
            frame: (height, width, spec.frame_channels as usize),
            zoom: ((FRAME_SIDE + longer / 2) / longer).max(1),
            envs,
            has_panel,
            local: local.map(|(k, (rows, columns))| Local {
                k,
                rows,
                columns,
                candidates,
            }),
            action_names: config.action_names(),
            support: config.model.atoms_support(),
        }
    }

    /// A: actions that the agent has.
    pub(super) fn actions(&self) -> usize {
        self.action_names.len()
    }

    /// A * N: numbers of all its distributions.
    pub(super) fn logits(&self) -> usize {
        self.actions() * self.support.len()
    }

    /// L: places of local features.
    pub(super) fn locations(&self) -> usize {
        self.local.as_ref().map_or(0, |it| it.rows * it.columns)
    }

    /// Pixels across and down of a picture.
    pub(super) fn size(&self) -> (usize, usize) {
        let (width, height) = self.tile();
        let columns = self.columns();
        let rows = self.envs.div_ceil(columns);
        let along = |count: usize, side: usize| MARGIN + count * (side + MARGIN);
        (along(columns, width), along(rows, height))
    }

    /// Up to four frames beside each other; where words stand beside each, they stand below each other, up to four.
    fn columns(&self) -> usize {
        match self.has_panel {
            false => self.envs.clamp(1, 4),
            true => self.envs.div_ceil(4).max(1),
        }
    }

    fn enlarged(&self) -> (usize, usize) {
        let (height, width, _) = self.frame;
        (width * self.zoom, height * self.zoom)
    }

    fn tile(&self) -> (usize, usize) {
        let (width, height) = self.enlarged();
        if !self.has_panel {
            return (width, height);
        }
        let with_panel = width + MARGIN + PANEL_WIDTH;
        match self.local {
            None => (with_panel, height.max(PANEL_HEIGHT)),
            Some(_) => (
                with_panel + MARGIN + width,
                (height + LEADING).max(PANEL_HEIGHT),
            ),
        }
    }

    pub(super) fn draw(
        &self,
        picture: &mut Picture,
        i: usize,
        shot: &Shot,
        look: Option<Look<'_>>,
    ) {
        let (tile_width, tile_height) = self.tile();
        let (column, row) = (i % self.columns(), i / self.columns());
        let x = MARGIN + column * (tile_width + MARGIN);
        let y = MARGIN + row * (tile_height + MARGIN);
        let (height, width, channels) = self.frame;
        let image = Image {
            pixels: &shot.frame,
            height,
            width,
            channels,
        };
        picture.image((x, y), self.zoom, image);
        let Some(look) = look else { return };
        let (frame_width, frame_height) = self.enlarged();
        let panel = Area {
            x: x + frame_width + MARGIN,
            y,
            width: PANEL_WIDTH,
            height: tile_height,
        };
        self.draw_panel(picture, panel, shot, look);
        if let Some(local) = &self.local {
            let map = Area {
                x: panel.x + PANEL_WIDTH + MARGIN,
                y,
                width: frame_width,
                height: frame_height,
            };
            let unknown = vec![f64::NAN; local.rows * local.columns];
            picture.cells(map, local.columns, look.matches.unwrap_or(&unknown));
            let words = format!("local DIM, k = {}, chance 1/{}", local.k, local.candidates);
            let below = (map.x, y + frame_height + LEADING - 4);
            picture.text(below, map.width, Ink::Soft, &words);
        }
    }

    fn draw_panel(&self, picture: &mut Picture, area: Area, shot: &Shot, look: Look<'_>) {
        let action = usize::from(shot.action);
        let name = &self.action_names[action];
        let q_values = look.q_values.iter().copied();
        let best = q_values.fold(f32::NEG_INFINITY, f32::max);
        let q = look.q_values[action];
        let chance = if q < best { " (by chance)" } else { "" };
        let Shot { episode, step, .. } = shot;
        let Shot { total, reward, .. } = shot;
        let lines = [
            (Ink::Soft, format!("episode {episode}, step {step}")),
            (Ink::Plain, format!("return {total:.2} ({reward:+.2})")),
            (Ink::Plain, format!("value {best:.3}")),
            (Ink::Bold, format!("{name}{chance}")),
        ];
        for (line, (ink, text)) in lines.iter().enumerate() {
            let at = (area.x, area.y + 13 + line * LEADING);
            picture.text(at, area.width, *ink, text);
        }
        let (atoms, used) = (self.support.len(), lines.len() * LEADING + 8);
        let bars = Area {
            y: area.y + used,
            height: area.height - used - LEADING,
            ..area
        };
        let probabilities = &look.probabilities[action * atoms..][..atoms];
        let most = probabilities.iter().copied();
        let most = most.fold(f32::MIN_POSITIVE, f32::max);
        let heights: Vec<_> = probabilities.iter().map(|p| f64::from(p / most)).collect();
        let (low, high) = (self.support[0], self.support[atoms - 1]);
        picture.bars(bars, &heights, Some(f64::from((q - low) / (high - low))));
        let words = format!("its return, {low} to {high}: {q:.3}");
        let below = (area.x, area.y + area.height - 4);
        picture.text(below, area.width, Ink::Soft, &words);
    }
}
