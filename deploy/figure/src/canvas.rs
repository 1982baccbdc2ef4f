//! A list of shapes in figure units: what a figure is before it becomes SVG, PDF or PNG.
//! It knows no axis and no file.

use super::{
    colours::{Colour, INK},
    font::{self, Weight},
};

/// A point: x to the right, y downwards.
pub(super) type Point = (f64, f64);

/// A rectangle by its upper left corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rect {
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) width: f64,
    pub(super) height: f64,
}

impl Rect {
    pub(super) const fn new(x: f64, y: f64, width: f64, height: f64) -> Self {
        Self {
            x,
            y,
            width,
            height,
        }
    }

    pub(super) const fn right(&self) -> f64 {
        self.x + self.width
    }

    pub(super) const fn bottom(&self) -> f64 {
        self.y + self.height
    }
}

/// Where a text stands from its point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

/// How a text looks.
#[derive(Clone, Copy, Debug)]
pub(super) struct TextStyle {
    pub(super) size: f64,
    pub(super) weight: Weight,
    pub(super) colour: Colour,
    pub(super) anchor: Anchor,
    /// Turned to run upwards.
    pub(super) upright: bool,
}

impl TextStyle {
    /// Regular letters from left to right.
    pub(super) const fn new(size: f64, colour: Colour, anchor: Anchor) -> Self {
        Self {
            size,
            weight: Weight::Regular,
            colour,
            anchor,
            upright: false,
        }
    }

    pub(super) const fn bold(self) -> Self {
        let weight = Weight::Bold;
        Self { weight, ..self }
    }

    pub(super) const fn upright(self) -> Self {
        let upright = true;
        Self { upright, ..self }
    }
}

/// How a line is drawn: colour, width, dashes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stroke {
    pub(super) colour: Colour,
    pub(super) width: f64,
    pub(super) dashed: bool,
}

impl Stroke {
    pub(super) const fn solid(colour: Colour, width: f64) -> Self {
        Self {
            colour,
            width,
            dashed: false,
        }
    }
}

/// One shape or text of a picture, in the order of drawing.
#[derive(Debug)]
pub(super) enum Shape {
    /// A line through points.
    Line { points: Vec<Point>, stroke: Stroke },
    /// A filled polygon.
    Area { points: Vec<Point>, fill: Colour },
    /// Filled rectangles of one colour, with hard edges.
    Rects { rects: Vec<Rect>, fill: Colour },
    /// A rectangle's rim.
    Frame { rect: Rect, stroke: Stroke },
    /// A background with round corners.
    Card {
        rect: Rect,
        fill: Colour,
        border: Colour,
    },
    /// A line of text whose baseline is at the point.
    Text {
        at: Point,
        text: String,
        style: TextStyle,
    },
}

/// Radius of a card's corners.
pub(super) const CARD_RADIUS: f64 = 8.0;
/// Drawn and left out of a dashed line.
pub(super) const DASH: [f64; 2] = [6.0, 4.0];

/// Shapes in the order in which they are drawn.
#[derive(Debug)]
pub(super) struct Canvas {
    pub(super) width: f64,
    pub(super) height: f64,
    pub(super) shapes: Vec<Shape>,
}

impl Canvas {
    pub(super) const fn new(width: f64, height: f64) -> Self {
        Self {
            width,
            height,
            shapes: Vec::new(),
        }
    }

    pub(super) fn line(&mut self, points: Vec<Point>, stroke: Stroke) {
        // A line without length has no direction to be drawn in.
        if points.iter().any(|point| *point != points[0]) {
            self.shapes.push(Shape::Line { points, stroke });
        }
    }

    pub(super) fn area(&mut self, points: Vec<Point>, fill: Colour) {
        if points.len() > 2 {
            self.shapes.push(Shape::Area { points, fill });
        }
    }

    /// Draws a filled disc.
    pub(super) fn dot(&mut self, middle: Point, radius: f64, fill: Colour) {
        self.area(circle(middle, radius).collect(), fill);
    }

    /// Draws a circle that is not filled.
    pub(super) fn ring(&mut self, middle: Point, radius: f64, colour: Colour) {
        let again = circle(middle, radius).take(1);
        let points = circle(middle, radius).chain(again).collect();
        self.line(points, Stroke::solid(colour, 1.4));
    }

    pub(super) fn rects(&mut self, rects: Vec<Rect>, fill: Colour) {
        if !rects.is_empty() {
            self.shapes.push(Shape::Rects { rects, fill });
        }
    }

    pub(super) fn frame(&mut self, rect: Rect, stroke: Stroke) {
        self.shapes.push(Shape::Frame { rect, stroke });
    }

    pub(super) fn card(&mut self, rect: Rect, fill: Colour, border: Colour) {
        self.shapes.push(Shape::Card { rect, fill, border });
    }

    pub(super) fn text(&mut self, at: Point, text: &str, style: TextStyle) {
        if !text.is_empty() {
            let text = text.to_owned();
            self.shapes.push(Shape::Text { at, text, style });
        }
    }
}

/// A circle as a polygon of 16 sides.
fn circle((x, y): Point, radius: f64) -> impl Iterator<Item = Point> {
    (0..16).map(move |i| {
        let angle = f64::from(i) * std::f64::consts::TAU / 16.0;
        (x + radius * angle.cos(), y + radius * angle.sin())
    })
}

/// Draws a panel's title and returns what is left below it.
pub(super) fn titled(canvas: &mut Canvas, place: Rect, title: &str) -> Rect {
    const SIZE: f64 = 14.0;
    let style = TextStyle::new(SIZE, INK, Anchor::Start).bold();
    let lines = font::wrap(title, SIZE, place.width);
    for (index, line) in lines.iter().enumerate() {
        let y = place.y + SIZE + index as f64 * (SIZE + 4.0);
        canvas.text((place.x, y), line, style);
    }
    let used = lines.len() as f64 * (SIZE + 4.0) + 6.0;
    Rect::new(place.x, place.y + used, place.width, place.height - used)
}
