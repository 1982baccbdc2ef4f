//! A square grid of black and white cells, such as spins.
//! Adjacent dark cells of a row become one rectangle, so that a picture of thousands of cells stays small.

use super::{
    canvas::{Canvas, Rect, draw_title},
    colours::{CARD_BORDER, CELL_DARK, CELL_LIGHT},
    heat::draw_outline,
};

/// A square grid of cells.
#[derive(Clone, Debug)]
pub struct Lattice {
    /// The title above the panel.
    pub title: String,
    /// The number of cells in a row and in a column.
    pub side: usize,
    /// Whether each cell is dark, row by row.
    pub dark: Vec<bool>,
    /// A frame that marks part of the lattice, in cells.
    pub outline: Option<Rect>,
}

impl Lattice {
    pub(super) fn draw(&self, canvas: &mut Canvas, area: Rect) {
        let area = draw_title(canvas, area, &self.title);
        let room = area.width.min(area.height);
        // Whole units if a cell is at least one unit wide: this gives short numbers and sharp edges.
        let cell = match (room / self.side as f64).floor() {
            whole if whole >= 1.0 => whole,
            _ => room / self.side as f64,
        };
        let size = cell * self.side as f64;
        let map = Rect::new(area.x.round(), area.y.round(), size, size);
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
            draw_outline(canvas, map, cell, outline);
        }
    }
}
