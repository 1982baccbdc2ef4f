//! A canvas that writes shapes as SVG, in figure units, in the order in which they are drawn. Numbers are rounded to two decimals.
//! The canvas knows nothing about axes and files.

use super::{
    colours::{Colour, INK},
    font::{self, Weight},
};

/// Fonts for the viewer to choose from: the one used to measure widths, then fonts that are nearly as wide.
const FONTS: &str = "DejaVu Sans, Verdana, Segoe UI, Helvetica, Arial, sans-serif";

/// A point (x, y): x points to the right, y downwards.
pub(super) type Point = (f64, f64);

/// An axis-aligned rectangle, given by its upper left corner and its size: in pixels of a picture, or in cells of a map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect {
    /// The distance of the left edge from that of the whole.
    pub x: f64,
    /// The distance of the upper edge from that of the whole.
    pub y: f64,
    /// The distance between left and right edge.
    pub width: f64,
    /// The distance between upper and lower edge.
    pub height: f64,
}

impl Rect {
    /// Creates a rectangle with this upper left corner and this size.
    pub const fn new(x: f64, y: f64, width: f64, height: f64) -> Self {
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

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct TextStyle {
    pub(super) size: f64,
    pub(super) weight: Weight,
    pub(super) colour: Colour,
    pub(super) anchor: Anchor,
    /// Whether the text is rotated to run upwards.
    pub(super) upright: bool,
    /// The length at which a text is cut.
    length_max: f64,
}

impl TextStyle {
    /// Creates a style with regular weight, horizontal and without a length limit.
    pub(super) const fn new(size: f64, colour: Colour, anchor: Anchor) -> Self {
        Self {
            size,
            weight: Weight::Regular,
            colour,
            anchor,
            upright: false,
            length_max: f64::INFINITY,
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

    pub(super) const fn cut_at(self, length_max: f64) -> Self {
        Self { length_max, ..self }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Letters {
    /// As text, in a font that the viewer has.
    Text,
    /// As outlines, in the built-in font.
    Outlines,
}

/// Shapes in the order in which they are drawn.
#[derive(Debug)]
pub(super) struct Canvas {
    pub(super) width: f64,
    pub(super) height: f64,
    letters: Letters,
    elements: String,
}

impl Canvas {
    pub(super) const fn new(width: f64, height: f64, letters: Letters) -> Self {
        Self {
            width,
            height,
            letters,
            elements: String::new(),
        }
    }

    /// Returns the SVG text, which ends with a newline.
    pub(super) fn svg(&self) -> String {
        let [width, height] = [self.width, self.height].map(rounded);
        let size = format!(r#"width="{width}" height="{height}" viewBox="0 0 {width} {height}""#);
        let style = format!(r#"font-family="{FONTS}" stroke-linejoin="round""#);
        let elements = &self.elements;
        format!("<svg xmlns='http://www.w3.org/2000/svg' {size} {style}>\n{elements}</svg>\n")
    }

    fn add(&mut self, element: &str) {
        self.elements.push_str(element);
        self.elements.push('\n');
    }

    pub(super) fn line(&mut self, points: &[Point], colour: Colour, width: f64) {
        self.polyline(points, &pen(colour, width));
    }

    pub(super) fn dashed_line(&mut self, points: &[Point], colour: Colour, width: f64) {
        let pen = pen(colour, width);
        self.polyline(points, &format!(r#"{pen} stroke-dasharray="6 4""#));
    }

    fn polyline(&mut self, points: &[Point], pen: &str) {
        // Points that all coincide give no visible line.
        if points.iter().any(|point| *point != points[0]) {
            let points = format!(r#"points="{}""#, point_list(points));
            self.add(&format!(r#"<polyline {points} fill="none" {pen}/>"#));
        }
    }

    pub(super) fn polygon(&mut self, points: &[Point], fill: Colour) {
        if points.len() > 2 {
            let (points, brush) = (point_list(points), brush(fill));
            self.add(&format!(r#"<polygon points="{points}" {brush}/>"#));
        }
    }

    pub(super) fn dot(&mut self, middle: Point, radius: f64, fill: Colour) {
        self.circle(middle, radius, &brush(fill));
    }

    pub(super) fn ring(&mut self, middle: Point, radius: f64, colour: Colour) {
        let pen = pen(colour, 1.4);
        self.circle(middle, radius, &format!(r#"fill="none" {pen}"#));
    }

    fn circle(&mut self, (x, y): Point, radius: f64, ink: &str) {
        let [x, y] = [x, y].map(rounded);
        let attributes = format!(r#"cx="{x}" cy="{y}" r="{radius}""#);
        self.add(&format!("<circle {attributes} {ink}/>"));
    }

    /// Draws filled rectangles of one colour with sharp edges. Rectangles with a side of 0 or NaN are skipped.
    pub(super) fn rects(&mut self, rects: &[Rect], fill: Colour) {
        let visible = rects.iter().filter(|it| it.width > 0.0 && it.height > 0.0);
        let path = visible.map(|it| {
            let [x, y, w, h] = [it.x, it.y, it.width, it.height].map(rounded);
            format!("M{x} {y}h{w}v{h}h-{w}z")
        });
        let (path, brush) = (path.collect::<String>(), brush(fill));
        if !path.is_empty() {
            self.add(&format!(
                r#"<path d="{path}" {brush} shape-rendering="crispEdges"/>"#
            ));
        }
    }

    pub(super) fn frame(&mut self, rect: Rect, colour: Colour, width: f64) {
        let (bounds, pen) = (bounds(rect), pen(colour, width));
        self.add(&format!(r#"<rect {bounds} fill="none" {pen}/>"#));
    }

    pub(super) fn card(&mut self, rect: Rect, fill: Colour, border: Colour) {
        let pen = pen(border, 1.0);
        let (bounds, brush) = (bounds(rect), brush(fill));
        self.add(&format!(r#"<rect {bounds} rx="8" {brush} {pen}/>"#));
    }

    /// Writes a line of text with its baseline at the point. Text longer than the style allows is cut.
    pub(super) fn text(&mut self, (x, y): Point, text: &str, style: TextStyle) {
        let text = font::fit(text, style.size, style.weight, style.length_max);
        if text.is_empty() {
            return;
        }
        let ([x, y], brush) = ([x, y].map(rounded), brush(style.colour));
        let (anchor, share_left) = match style.anchor {
            Anchor::Start => ("start", 0.0),
            Anchor::Middle => ("middle", 0.5),
            Anchor::End => ("end", 1.0),
        };
        let turn = if style.upright { " rotate(-90)" } else { "" };
        let place = format!(r#"transform="translate({x} {y}){turn}""#);
        if self.letters == Letters::Outlines {
            let left = -share_left * font::width(&text, style.size, style.weight);
            let path = font::outline(&text, style.size, style.weight, left);
            self.add(&format!(r#"<path d="{path}" {place} {brush}/>"#));
            return;
        }
        let weight = match style.weight {
            Weight::Regular => "normal",
            Weight::Bold => "bold",
        };
        let size = rounded(style.size);
        let font = format!(r#"font-size="{size}" font-weight="{weight}" text-anchor="{anchor}""#);
        let text = text.replace('&', "&amp;").replace('<', "&lt;");
        self.add(&format!("<text {place} {font} {brush}>{text}</text>"));
    }
}

fn point_list(points: &[Point]) -> String {
    let point = |(x, y): &Point| format!("{},{}", rounded(*x), rounded(*y));
    points.iter().map(point).collect::<Vec<_>>().join(" ")
}

fn bounds(rect: Rect) -> String {
    let [x, y, width, height] = [rect.x, rect.y, rect.width, rect.height].map(rounded);
    format!(r#"x="{x}" y="{y}" width="{width}" height="{height}""#)
}

fn brush(colour: Colour) -> String {
    let opacity = match colour.alpha < 1.0 {
        true => format!(r#" fill-opacity="{:.2}""#, colour.alpha),
        false => String::new(),
    };
    format!(r#"fill="{}"{opacity}"#, colour.hex())
}

fn pen(colour: Colour, width: f64) -> String {
    let (hex, width) = (colour.hex(), rounded(width));
    format!(r#"stroke="{hex}" stroke-width="{width}""#)
}

/// Rounds to two decimals: more would make the file longer without a visible gain.
fn rounded(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}

/// Draws a panel's title and returns the rectangle below it.
pub(super) fn draw_title(canvas: &mut Canvas, area: Rect, title: &str) -> Rect {
    const SIZE: f64 = 14.0;
    let style = TextStyle::new(SIZE, INK, Anchor::Start).bold();
    let lines = font::wrap(title, SIZE, area.width);
    for (index, line) in lines.iter().enumerate() {
        let y = area.y + SIZE + index as f64 * (SIZE + 4.0);
        canvas.text((area.x, y), line, style);
    }
    let used = lines.len() as f64 * (SIZE + 4.0) + 6.0;
    Rect::new(area.x, area.y + used, area.width, area.height - used)
}
