//! A picture made of pixels, such as a frame of a [`Film`](crate::Film): enlarged images, and above them text, bars and heat cells.
//! A [`Figure`](crate::Figure) can be written as SVG or PDF; a picture cannot.

use resvg::tiny_skia::{Color, Pixmap, PremultipliedColorU8, Transform};

use crate::{
    canvas::{Anchor, Canvas, Letters, Point, Rect, TextStyle},
    colours::{CARD, GREY, INK, INK_SOFT, heat_colour, series_colour},
    render::{self, FigureError},
};

/// The style of a line of text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ink {
    /// Regular weight, for running text.
    Plain,
    /// Bold, for what the viewer should read first.
    Bold,
    /// Regular weight in a softer colour, for explanations.
    Soft,
}

/// Pixels on a light card. Positions are in pixels from the upper left corner.
pub struct Picture {
    images: Pixmap,
    /// The shapes drawn above the images.
    shapes: Canvas,
}

impl Picture {
    /// Creates an empty picture of this size in pixels.
    pub fn new(width: usize, height: usize) -> Result<Self, FigureError> {
        let mut images = render::new_pixmap(width, height)?;
        let [r, g, b] = CARD.rgb;
        images.fill(Color::from_rgba8(r, g, b, u8::MAX));
        let shapes = Canvas::new(width as f64, height as f64, Letters::Outlines);
        Ok(Self { images, shapes })
    }

    /// Returns the width and the height in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.images.width() as usize, self.images.height() as usize)
    }

    /// Draws an image of bytes, whose shape is [H, W, C], at (x, y). Each image pixel becomes a square of `zoom` pixels; parts outside the
    /// picture are cut off. Three channels are red, green and blue; otherwise the first channel is drawn as grey.
    pub fn image(&mut self, (x, y): (usize, usize), zoom: usize, bytes: &[u8], shape: [usize; 3]) {
        let (width, height) = self.size();
        let [rows, columns, channels] = shape;
        for row in y..(y + rows * zoom).min(height) {
            for column in x..(x + columns * zoom).min(width) {
                let source = (row - y) / zoom * columns + (column - x) / zoom;
                let pixel = &bytes[source * channels..];
                let rgb = match channels {
                    3 => [pixel[0], pixel[1], pixel[2]],
                    _ => [pixel[0]; 3],
                };
                self.images.pixels_mut()[row * width + column] = opaque(rgb);
            }
        }
    }

    /// Writes a line of text whose baseline starts at `at`. Text wider than `width_max` is cut.
    pub fn text(&mut self, at: Point, width_max: f64, ink: Ink, text: &str) {
        let style = |colour| TextStyle::new(13.0, colour, Anchor::Start).cut_at(width_max);
        let style = match ink {
            Ink::Plain => style(INK),
            Ink::Bold => style(INK).bold(),
            Ink::Soft => style(INK_SOFT),
        };
        self.shapes.text(at, text, style);
    }

    /// Draws bars of these heights (0..=1) side by side on the lower edge of `area`, and a vertical line at `mark`. `mark` is a share of
    /// the width in 0..=1, from the left.
    pub fn bars(&mut self, area: Rect, heights: &[f64], mark: f64) {
        let step = area.width / heights.len().max(1) as f64;
        let gap = if step > 3.0 { 1.0 } else { 0.0 };
        let bars = heights.iter().enumerate().map(|(i, share)| {
            let height = share.clamp(0.0, 1.0) * area.height;
            let (x, y) = (area.x + i as f64 * step, area.bottom() - height);
            Rect::new(x, y, step - gap, height)
        });
        let bars: Vec<Rect> = bars.collect();
        self.shapes.rects(&bars, series_colour(0));
        let floor = [(area.x, area.bottom()), (area.right(), area.bottom())];
        self.shapes.line(&floor, GREY, 2.0);
        let x = area.x + mark.clamp(0.0, 1.0) * area.width;
        let line = [(x, area.y), (x, area.bottom())];
        self.shapes.line(&line, series_colour(1), 2.0);
    }

    /// Draws rows of `columns` cells that fill `area`. Values in 0..=1 are drawn dark to light; a value that is not finite is grey.
    pub fn cells(&mut self, area: Rect, columns: usize, values: &[f64]) {
        let columns = columns.max(1);
        let rows = values.len().div_ceil(columns).max(1);
        // Edges lie at whole pixels, so that no line shows between cells.
        let edge = |i: usize, n: usize, length: f64| (i as f64 * length / n as f64).floor();
        for (index, &value) in values.iter().enumerate() {
            let (row, column) = (index / columns, index % columns);
            let [left, right] = [column, column + 1].map(|i| edge(i, columns, area.width));
            let [top, bottom] = [row, row + 1].map(|i| edge(i, rows, area.height));
            let cell = Rect::new(area.x + left, area.y + top, right - left, bottom - top);
            self.shapes.rects(&[cell], heat_colour(value));
        }
    }

    /// Encodes the picture as a PNG.
    pub fn png(&self) -> Result<Vec<u8>, FigureError> {
        render::encode_png(&self.pixels())
    }

    /// Returns red, green and blue of every pixel, row by row.
    pub(crate) fn rgb(&self) -> Vec<[u8; 3]> {
        let pixels = self.pixels();
        // The opaque card lies under everything, so no pixel is transparent.
        let rgb = |it: &PremultipliedColorU8| [it.red(), it.green(), it.blue()];
        pixels.pixels().iter().map(rgb).collect()
    }

    fn pixels(&self) -> Pixmap {
        let mut pixels = self.images.clone();
        let tree = render::parse_svg(&self.shapes.svg()).expect("the SVG is ours, and has an area");
        resvg::render(&tree, Transform::identity(), &mut pixels.as_mut());
        pixels
    }
}

fn opaque([r, g, b]: [u8; 3]) -> PremultipliedColorU8 {
    PremultipliedColorU8::from_rgba(r, g, b, u8::MAX).expect("no channel is above an opaque alpha")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_enlarged_pixel_by_pixel_and_cut_at_the_edge() {
        let mut picture = Picture::new(5, 4).unwrap();
        picture.image((1, 1), 3, &[1, 2, 3, 40, 50, 60], [1, 2, 3]);
        let rgb = picture.rgb();
        let at = |x: usize, y: usize| rgb[y * 5 + x];
        assert_eq!([at(0, 1), at(1, 0)], [[255; 3]; 2]);
        assert_eq!([at(1, 1), at(3, 3)], [[1, 2, 3]; 2]);
        assert_eq!([at(4, 1), at(4, 3)], [[40, 50, 60]; 2]);
        // An image with one channel is drawn as grey.
        picture.image((0, 0), 1, &[7], [1, 1, 1]);
        assert_eq!(picture.rgb()[0], [7; 3]);
    }

    #[test]
    fn bars_stand_on_their_edge_and_cells_fill_their_area() {
        let mut picture = Picture::new(20, 10).unwrap();
        let area = Rect::new(0.0, 0.0, 20.0, 10.0);
        picture.bars(area, &[1.0, f64::NAN], 0.5);
        let rgb = picture.rgb();
        let found = [rgb[0], rgb[10], rgb[19]];
        let wanted = [series_colour(0), series_colour(1), CARD];
        assert_eq!(found, wanted.map(|it| it.rgb));
        picture.cells(area, 2, &[0.0, 1.0, f64::NAN, 0.5]);
        let rgb = picture.rgb();
        let found = [rgb[0], rgb[19], rgb[9 * 20], rgb[10 * 20 - 1]];
        let wanted = [0.0, 1.0, f64::NAN, 0.5].map(|value| heat_colour(value).rgb);
        assert_eq!(found, wanted);
        assert!(Picture::new(0, 3).is_err());
    }

    #[test]
    fn text_leaves_ink_within_its_width() {
        let mut picture = Picture::new(60, 20).unwrap();
        picture.text((2.0, 14.0), 40.0, Ink::Bold, "a very long sentence");
        let rgb = picture.rgb();
        let inked = |x: usize| (0..20).any(|y| rgb[y * 60 + x] != CARD.rgb);
        assert!((2..42).any(inked));
        assert!(!(43..60).any(inked));
    }
}
