//! A picture of pixels, one of many: images enlarged, and above them text, bars and cells of heat.
//! Unlike a [`Figure`](crate::Figure) it is written as pixels alone.

use resvg::tiny_skia::{Color, Pixmap, PremultipliedColorU8, Transform};

use crate::{
    canvas::{Anchor, Canvas, Letters, Point, Rect, TextStyle},
    colours::{CARD, GREY, INK, INK_SOFT, heat_colour, series_colour},
    error::FigureError,
    render,
};

/// Bytes of an image [H, W, C], channels last: of three channels as red, green and blue, of any other number the first as grey.
#[derive(Clone, Copy, Debug)]
pub struct Image<'a> {
    /// The bytes.
    pub pixels: &'a [u8],
    /// H.
    pub height: usize,
    /// W.
    pub width: usize,
    /// C.
    pub channels: usize,
}

/// How a line of text looks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ink {
    /// As running text.
    Plain,
    /// What is looked at first.
    Bold,
    /// What explains.
    Soft,
}

/// Pixels on a light card, places in pixels from its upper left corner.
pub struct Picture {
    /// The card and the images.
    images: Pixmap,
    /// What lies above them.
    shapes: Canvas,
}

impl Picture {
    /// An empty picture of this size in pixels.
    pub fn new(width: usize, height: usize) -> Result<Self, FigureError> {
        let mut images = render::pixmap(width, height)?;
        let [r, g, b] = CARD.rgb;
        images.fill(Color::from_rgba8(r, g, b, u8::MAX));
        let shapes = Canvas::new(width as f64, height as f64, Letters::Outlines);
        Ok(Self { images, shapes })
    }

    /// Pixels across and down.
    pub fn size(&self) -> (usize, usize) {
        (self.images.width() as usize, self.images.height() as usize)
    }

    /// Puts an image at (x, y), each of its pixels as a square of `zoom` pixels; what lies outside is left out.
    pub fn image(&mut self, (x, y): (usize, usize), zoom: usize, image: Image<'_>) {
        let (width, height) = self.size();
        for row in y..(y + image.height * zoom).min(height) {
            for column in x..(x + image.width * zoom).min(width) {
                let source = (row - y) / zoom * image.width + (column - x) / zoom;
                let pixel = &image.pixels[source * image.channels..];
                let rgb = match image.channels {
                    3 => [pixel[0], pixel[1], pixel[2]],
                    _ => [pixel[0]; 3],
                };
                self.images.pixels_mut()[row * width + column] = opaque(rgb);
            }
        }
    }

    /// Writes a line whose baseline starts at `at`, cut to `width_max`.
    pub fn text(&mut self, at: Point, width_max: f64, ink: Ink, text: &str) {
        let style = |colour| TextStyle::new(13.0, colour, Anchor::Start).within(width_max);
        let style = match ink {
            Ink::Plain => style(INK),
            Ink::Bold => style(INK).bold(),
            Ink::Soft => style(INK_SOFT),
        };
        self.shapes.text(at, text, style);
    }

    /// Bars that stand on the lower edge of `area` beside each other, of these heights in 0..=1; and a line across at `mark`, a place in
    /// 0..=1 from left to right.
    pub fn bars(&mut self, area: Rect, heights: &[f64], mark: f64) {
        let step = area.width / heights.len().max(1) as f64;
        let gap = if step > 3.0 { 1.0 } else { 0.0 };
        let bars = heights.iter().enumerate().map(|(i, share)| {
            let tall = share.clamp(0.0, 1.0) * area.height;
            let (x, y) = (area.x + i as f64 * step, area.bottom() - tall);
            Rect::new(x, y, step - gap, tall)
        });
        let bars: Vec<Rect> = bars.collect();
        self.shapes.rects(&bars, series_colour(0));
        let floor = [(area.x, area.bottom()), (area.right(), area.bottom())];
        self.shapes.line(&floor, GREY, 2.0);
        let x = area.x + mark.clamp(0.0, 1.0) * area.width;
        let line = [(x, area.y), (x, area.bottom())];
        self.shapes.line(&line, series_colour(1), 2.0);
    }

    /// Rows of `columns` cells that fill `area`, dark to light for values in 0..=1; one that is not a number is grey.
    pub fn cells(&mut self, area: Rect, columns: usize, values: &[f64]) {
        let columns = columns.max(1);
        let rows = values.len().div_ceil(columns).max(1);
        // Edges at whole pixels, so that no line shows between cells.
        let edge = |at: usize, of: usize, length: f64| (at as f64 * length / of as f64).floor();
        for (index, &value) in values.iter().enumerate() {
            let (row, column) = (index / columns, index % columns);
            let [left, right] = [column, column + 1].map(|at| edge(at, columns, area.width));
            let [top, bottom] = [row, row + 1].map(|at| edge(at, rows, area.height));
            let cell = Rect::new(area.x + left, area.y + top, right - left, bottom - top);
            self.shapes.rects(&[cell], heat_colour(value));
        }
    }

    /// The picture as a PNG.
    pub fn png(&self) -> Result<Vec<u8>, FigureError> {
        render::packed(&self.pixels())
    }

    /// Red, green and blue of every pixel.
    pub(crate) fn rgb(&self) -> Vec<[u8; 3]> {
        let pixels = self.pixels();
        // A card lies under everything, so nothing is transparent.
        let rgb = |it: &PremultipliedColorU8| [it.red(), it.green(), it.blue()];
        pixels.pixels().iter().map(rgb).collect()
    }

    fn pixels(&self) -> Pixmap {
        let mut pixels = self.images.clone();
        let shapes = render::tree(&self.shapes.svg()).expect("the SVG is ours, and has an area");
        resvg::render(&shapes, Transform::identity(), &mut pixels.as_mut());
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
        let image = Image {
            pixels: &[1, 2, 3, 40, 50, 60],
            height: 1,
            width: 2,
            channels: 3,
        };
        picture.image((1, 1), 3, image);
        let rgb = picture.rgb();
        let at = |x: usize, y: usize| rgb[y * 5 + x];
        assert_eq!([at(0, 1), at(1, 0)], [[255; 3]; 2]);
        assert_eq!([at(1, 1), at(3, 3)], [[1, 2, 3]; 2]);
        assert_eq!([at(4, 1), at(4, 3)], [[40, 50, 60]; 2]);
        // One byte a pixel is grey.
        let grey = Image {
            pixels: &[7],
            height: 1,
            width: 1,
            channels: 1,
        };
        picture.image((0, 0), 1, grey);
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
