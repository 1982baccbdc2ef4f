//! A square field of black and white cells, such as spins.
//! Runs of dark cells are one rectangle, so that a picture of thousands of cells stays small.

use super::{
    canvas::{Canvas, Rect, titled},
    colours::{CARD_BORDER, CELL_DARK, CELL_LIGHT},
    heat::{Outline, point_out},
};

/// A field of cells.
#[derive(Clone, Debug)]
pub struct Lattice {
    /// Over the panel.
    pub title: String,
    /// Cells in a row and in a column.
    pub side: usize,
    /// Row by row: whether a cell is dark.
    pub dark: Vec<bool>,
    /// A square to point out.
    pub outline: Option<Outline>,
}

impl Lattice {
    pub(super) fn draw(&self, canvas: &mut Canvas, place: Rect) {
        let place = titled(canvas, place, &self.title);
        let room = place.width.min(place.height);
        // Whole units where there is room for them: short numbers, sharp edges.
        let cell = match (room / self.side as f64).floor() {
            whole if whole >= 1.0 => whole,
            _ => room / self.side as f64,
        };
        let size = cell * self.side as f64;
        let map = Rect::new(place.x.round(), place.y.round(), size, size);
        canvas.rects(&[map], CELL_LIGHT);
        let mut runs = Vec::new();
        for (row, cells) in self.dark.chunks(self.side.max(1)).enumerate() {
            let (mut x, y) = (map.x, map.y + row as f64 * cell);
            for run in cells.chunk_by(|a, b| a == b) {
                let width = run.len() as f64 * cell;
                runs.extend(run[0].then(|| Rect::new(x, y, width, cell)));
                x += width;
            }
        }
        canvas.rects(&runs, CELL_DARK);
        canvas.frame(map, CARD_BORDER, 1.0);
        if let Some(outline) = self.outline {
            point_out(canvas, map, cell, outline);
        }
    }
}
