//! A picture of pixels, one of many: images enlarged, text, bars and cells of heat.
//! Unlike a [`Figure`](crate::Figure) it is drawn at once, and exists as pixels alone.

use resvg::tiny_skia::{Color, Pixmap, PremultipliedColorU8, Transform};

use crate::{
    canvas::{Anchor, Canvas, Letters, Rect, Stroke, TextStyle},
    colours::{CARD, GREY, INK, INK_SOFT, NO_VALUE, heat_colour, series_colour},
    error::FigureError,
    font, render,
};

/// An upright rectangle in pixels, by its upper left corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Area {
    /// Pixels from the left.
    pub x: usize,
    /// Pixels from above.
    pub y: usize,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
}

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

/// Pixels on a light card.
pub struct Picture(Pixmap);

impl Picture {
    /// An empty picture of this size in pixels.
    pub fn new(width: usize, height: usize) -> Result<Self, FigureError> {
        let mut pixmap = render::pixmap(width, height)?;
        let [r, g, b] = CARD.rgb;
        pixmap.fill(Color::from_rgba8(r, g, b, u8::MAX));
        Ok(Self(pixmap))
    }

    /// Pixels across and down.
    pub fn size(&self) -> (usize, usize) {
        (self.0.width() as usize, self.0.height() as usize)
    }

    /// Puts an image at (x, y), each of its pixels as a square of `zoom` pixels; what lies outside is left out.
    pub fn image(&mut self, (x, y): (usize, usize), zoom: usize, image: Image<'_>) {
        let (width, height) = self.size();
        let rows = y..(y + image.height * zoom).min(height);
        for row in rows {
            for column in x..(x + image.width * zoom).min(width) {
                let source = (row - y) / zoom * image.width + (column - x) / zoom;
                let pixel = &image.pixels[source * image.channels..];
                let rgb = match image.channels {
                    3 => [pixel[0], pixel[1], pixel[2]],
                    _ => [pixel[0]; 3],
                };
                self.0.pixels_mut()[row * width + column] = opaque(rgb);
            }
        }
    }

    /// Writes a line whose baseline starts at (x, y), cut to `width_max` pixels.
    pub fn text(&mut self, (x, y): (usize, usize), width_max: usize, ink: Ink, text: &str) {
        const SIZE: f64 = 13.0;
        let style = |colour| TextStyle::new(SIZE, colour, Anchor::Start);
        let style = match ink {
            Ink::Plain => style(INK),
            Ink::Bold => style(INK).bold(),
            Ink::Soft => style(INK_SOFT),
        };
        let text = font::fit(text, SIZE, style.weight, width_max as f64);
        self.draw(|canvas| canvas.text((x as f64, y as f64), &text, style));
    }

    /// Bars that stand on the lower edge of `area` beside each other, of these heights in 0..=1; and a line across at `mark`, a place in
    /// 0..=1 from left to right.
    pub fn bars(&mut self, area: Area, heights: &[f64], mark: Option<f64>) {
        let sides = [area.x, area.y, area.width, area.height];
        let [x, y, width, height] = sides.map(|length| length as f64);
        let step = width / heights.len().max(1) as f64;
        let gap = if step > 3.0 { 1.0 } else { 0.0 };
        let bars = heights.iter().enumerate().map(|(i, share)| {
            let tall = share.clamp(0.0, 1.0) * height;
            Rect::new(x + i as f64 * step, y + height - tall, step - gap, tall)
        });
        let bars: Vec<Rect> = bars.collect();
        self.draw(|canvas| {
            canvas.rects(&bars, series_colour(0));
            let floor = [(x, y + height), (x + width, y + height)];
            canvas.line(&floor, Stroke::solid(GREY, 2.0));
            if let Some(place) = mark {
                let at = x + place.clamp(0.0, 1.0) * width;
                let line = [(at, y), (at, y + height)];
                canvas.line(&line, Stroke::solid(series_colour(1), 2.0));
            }
        });
    }

    /// Rows of `columns` cells that fill `area`, dark to light for values in 0..=1; one that is not a number is grey.
    pub fn cells(&mut self, area: Area, columns: usize, values: &[f64]) {
        let columns = columns.max(1);
        let rows = values.len().div_ceil(columns).max(1);
        let edge = |at: usize, of: usize, length: usize| (at * length / of) as f64;
        self.draw(|canvas| {
            for (index, &value) in values.iter().enumerate() {
                let (row, column) = (index / columns, index % columns);
                let [left, right] = [column, column + 1].map(|at| edge(at, columns, area.width));
                let [top, bottom] = [row, row + 1].map(|at| edge(at, rows, area.height));
                let (x, y) = (area.x as f64 + left, area.y as f64 + top);
                let fill = match value.is_finite() {
                    true => heat_colour(value),
                    false => NO_VALUE,
                };
                canvas.rects(&[Rect::new(x, y, right - left, bottom - top)], fill);
            }
        });
    }

    /// Draws shapes over what is there.
    fn draw(&mut self, shapes: impl FnOnce(&mut Canvas)) {
        let (width, height) = self.size();
        let mut canvas = Canvas::new(width as f64, height as f64, Letters::Outlines);
        shapes(&mut canvas);
        let tree = render::tree(&canvas.into_svg()).expect("the SVG is ours, and has an area");
        resvg::render(&tree, Transform::identity(), &mut self.0.as_mut());
    }

    /// The picture as a PNG.
    pub fn png(&self) -> Result<Vec<u8>, FigureError> {
        render::packed(&self.0)
    }

    /// Red, green and blue of every pixel.
    pub(crate) fn rgb(&self) -> Vec<[u8; 3]> {
        let pixels = self.0.pixels().iter();
        // A card lies under everything, so nothing is transparent.
        pixels.map(|it| [it.red(), it.green(), it.blue()]).collect()
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
        let area = Area {
            x: 0,
            y: 0,
            width: 20,
            height: 10,
        };
        picture.bars(area, &[1.0, f64::NAN], None);
        let rgb = picture.rgb();
        assert_eq!(rgb[0], series_colour(0).rgb);
        assert_eq!(rgb[19], CARD.rgb);
        picture.cells(area, 2, &[0.0, 1.0, f64::NAN, 0.5]);
        let rgb = picture.rgb();
        let found = [rgb[0], rgb[19], rgb[9 * 20], rgb[10 * 20 - 1]];
        let wanted = [
            heat_colour(0.0),
            heat_colour(1.0),
            NO_VALUE,
            heat_colour(0.5),
        ];
        assert_eq!(found, wanted.map(|colour| colour.rgb));
        assert!(Picture::new(0, 3).is_err());
    }

    #[test]
    fn text_leaves_ink_within_its_width() {
        let mut picture = Picture::new(60, 20).unwrap();
        picture.text((2, 14), 40, Ink::Bold, "a very long sentence");
        let rgb = picture.rgb();
        let inked = |x: usize| (0..20).any(|y| rgb[y * 60 + x] != CARD.rgb);
        assert!((2..42).any(inked));
        assert!(!(43..60).any(inked));
    }
}
