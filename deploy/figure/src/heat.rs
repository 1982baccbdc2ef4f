//! A heat map: a matrix as square coloured cells, with a colour scale beside them.
//! The colours cover the range that the caller gives.

use super::{
    canvas::{Anchor, Canvas, Rect, TextStyle, draw_title},
    colours::{CARD, CELL_LIGHT, INK, INK_SOFT, OUTLINE, heat_colour, ink_on},
    font, ticks,
};

const TICK_SIZE: f64 = 11.5;
const LABEL_SIZE: f64 = 12.5;
const BAR_WIDTH: f64 = 12.0;
/// The smallest side of a cell that has its value written inside.
const CELL_TEXT_MIN: f64 = 25.0;
const BAR_STEPS: usize = 64;

/// The position of the cells in a larger square, such as the locations of a feature map in the input frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// The side of the field; it defines the unit of the other lengths.
    pub side: f64,
    /// The distance from the field's left and top edges to the first cell.
    pub first: f64,
    /// The side of a cell.
    pub cell: f64,
}

/// A square matrix with its title, names and scale.
#[derive(Clone, Debug, Default)]
pub struct Heat {
    /// The title above the panel.
    pub title: String,
    /// The number of cells in a row and in a column.
    pub side: usize,
    /// The values, row by row. A cell whose value is not finite is grey.
    pub values: Vec<f64>,
    /// The names of the rows, which are also those of the columns; empty if there are none.
    pub names: Vec<String>,
    /// The label under the columns and the label beside the rows, if those have names.
    pub labels: (String, String),
    /// The label beside the scale: what a value means, with its unit.
    pub unit: String,
    /// The ends of the scale, the first below the second.
    pub range: (f64, f64),
    /// The number of decimals of values written into cells that are large enough; `None` writes no values.
    pub decimals: Option<usize>,
    /// The larger square in which the cells lie; `None` if the cells fill the map.
    pub field: Option<Field>,
    /// A frame that marks part of the map, in cells, or in units of the field if there is one.
    pub outline: Option<Rect>,
}

impl Heat {
    /// Creates a heat map without names, whose scale is from 0 to 1.
    pub fn new(title: &str, side: usize, values: Vec<f64>) -> Self {
        assert_eq!(values.len(), side * side, "a square matrix");
        Self {
            title: title.to_owned(),
            side,
            values,
            range: (0.0, 1.0),
            ..Self::default()
        }
    }

    pub(super) fn draw(&self, canvas: &mut Canvas, area: Rect) {
        let area = draw_title(canvas, area, &self.title);
        let (low, high) = self.range;
        let bar_ticks = ticks::linear(low, high, 5);
        let bar_labels = ticks::labels(&bar_ticks);
        let bar_labels_width = font::max_width(&bar_labels, TICK_SIZE);
        let names_width = font::max_width(&self.names, TICK_SIZE);
        let (left, label_below) = match self.names.is_empty() {
            true => (0.0, 0.0),
            false => (names_width + LABEL_SIZE + 12.0, LABEL_SIZE + 6.0),
        };
        let right = 14.0 + BAR_WIDTH + 6.0 + bar_labels_width + LABEL_SIZE + 8.0;
        // Column names are rotated if they are longer than a cell is wide.
        let cell_guess = (area.width - left - right) / self.side as f64;
        let rotated = names_width > cell_guess - 2.0;
        let names_below = match (self.names.is_empty(), rotated) {
            (true, _) => 0.0,
            (false, true) => names_width + 6.0,
            (false, false) => TICK_SIZE + 6.0,
        };
        let below = names_below + label_below + 4.0;
        let map_side = (area.width - left - right).min(area.height - below);
        let map_side = map_side.max(10.0);
        let cell = map_side / self.side as f64;
        let map = Rect::new(area.x + left, area.y, map_side, map_side);

        let unit = self.field.map_or(cell, |field| map_side / field.side);
        let cells = match self.field {
            Some(field) => {
                canvas.rects(&[map], CELL_LIGHT);
                let size = field.cell * self.side as f64 * unit;
                let first = field.first * unit;
                Rect::new(map.x + first, map.y + first, size, size)
            }
            None => map,
        };
        self.draw_cells(canvas, cells);
        self.draw_names(canvas, map, cell, rotated);
        let style = text_style(LABEL_SIZE, Anchor::Middle).cut_at(map_side);
        let y = map.bottom() + names_below + LABEL_SIZE + 3.0;
        canvas.text((map.x + map_side / 2.0, y), &self.labels.0, style);
        let beside = (area.x + LABEL_SIZE - 2.0, map.y + map_side / 2.0);
        canvas.text(beside, &self.labels.1, style.upright());
        if let Some(outline) = self.outline {
            draw_outline(canvas, map, unit, outline);
        }

        let bar = Rect::new(map.right() + 14.0, map.y, BAR_WIDTH, map_side);
        let step = map_side / BAR_STEPS as f64;
        for i in 0..BAR_STEPS {
            let colour = heat_colour(1.0 - i as f64 / (BAR_STEPS - 1) as f64);
            let y = bar.y + i as f64 * step;
            canvas.rects(&[Rect::new(bar.x, y, BAR_WIDTH, step + 0.3)], colour);
        }
        for (tick, text) in bar_ticks.iter().zip(&bar_labels) {
            let y = bar.bottom() - (tick - low) / (high - low) * map_side;
            let mark = [(bar.right(), y), (bar.right() + 3.0, y)];
            canvas.line(&mark, INK_SOFT, 1.0);
            let at = (bar.right() + 6.0, y + TICK_SIZE * 0.36);
            canvas.text(at, text, text_style(TICK_SIZE, Anchor::Start));
        }
        let far = bar.right() + 6.0 + bar_labels_width + LABEL_SIZE + 4.0;
        canvas.text((far, bar.y + map_side / 2.0), &self.unit, style.upright());
    }

    fn draw_cells(&self, canvas: &mut Canvas, map: Rect) {
        let ((low, high), cell) = (self.range, map.width / self.side as f64);
        for (index, value) in self.values.iter().enumerate() {
            let (row, column) = (index / self.side, index % self.side);
            let (x, y) = (map.x + column as f64 * cell, map.y + row as f64 * cell);
            let colour = heat_colour((value - low) / (high - low));
            // Each cell overlaps the next a little, so that no line shows between them.
            canvas.rects(&[Rect::new(x, y, cell + 0.3, cell + 0.3)], colour);
            if let Some(decimals) = self.decimals.filter(|_| cell >= CELL_TEXT_MIN) {
                let size = (cell * 0.36).min(TICK_SIZE);
                let style = TextStyle::new(size, ink_on(colour), Anchor::Middle);
                let at = (x + cell / 2.0, y + cell / 2.0 + size * 0.36);
                canvas.text(at, &format!("{value:.decimals$}"), style);
            }
        }
    }

    fn draw_names(&self, canvas: &mut Canvas, map: Rect, cell: f64, rotated: bool) {
        for (index, name) in self.names.iter().enumerate() {
            let middle = (index as f64 + 0.5) * cell;
            let at = (map.x - 5.0, map.y + middle + TICK_SIZE * 0.36);
            canvas.text(at, name, text_style(TICK_SIZE, Anchor::End));
            if rotated {
                let at = (map.x + middle + TICK_SIZE * 0.36, map.bottom() + 5.0);
                canvas.text(at, name, text_style(TICK_SIZE, Anchor::End).upright());
            } else {
                let at = (map.x + middle, map.bottom() + TICK_SIZE + 3.0);
                canvas.text(at, name, text_style(TICK_SIZE, Anchor::Middle));
            }
        }
    }
}

/// Draws a marking frame over a map of square cells. `cell` is the drawn length of a unit of the outline.
pub(super) fn draw_outline(canvas: &mut Canvas, map: Rect, cell: f64, outline: Rect) {
    let lengths = [outline.x, outline.y, outline.width, outline.height];
    let [left, top, width, height] = lengths.map(|length| length * cell);
    let rect = Rect::new(map.x + left, map.y + top, width, height);
    canvas.frame(rect, CARD, 4.0);
    canvas.frame(rect, OUTLINE, 2.2);
}

const fn text_style(size: f64, anchor: Anchor) -> TextStyle {
    TextStyle::new(size, INK, anchor)
}
