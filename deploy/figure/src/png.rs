//! A canvas as PNG, text included, without any font of the machine.
//! It draws what `svg` writes, in the same places.

use tiny_skia::{
    FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, StrokeDash, Transform,
};

use super::{
    canvas::{Anchor, CARD_RADIUS, Canvas, DASH, Point, Rect, Shape, Stroke, TextStyle},
    colours::Colour,
    error::FigureError,
    font,
};

/// Sides up to this are none to tiny-skia, in pixels; a unit is a pixel or more.
const SIDE_MIN: f32 = 1.0 / 4096.0;

/// The picture, `zoom` pixels to a unit; what no shape covers is transparent.
pub(super) fn encode(canvas: &Canvas, zoom: f32) -> Result<Vec<u8>, FigureError> {
    let pixels = |length: f64| (length as f32 * zoom).ceil() as usize;
    let mut pixmap = pixmap(pixels(canvas.width), pixels(canvas.height))?;
    let scale = Transform::from_scale(zoom, zoom);
    for shape in &canvas.shapes {
        draw(&mut pixmap, shape, scale);
    }
    packed(&pixmap)
}

/// A picture of transparent pixels, to draw on.
pub(super) fn pixmap(width: usize, height: usize) -> Result<Pixmap, FigureError> {
    let size = u32::try_from(width).ok().zip(u32::try_from(height).ok());
    let pixmap = size.and_then(|(width, height)| Pixmap::new(width, height));
    pixmap.ok_or(FigureError::Size { width, height })
}

/// The pixels as a file.
pub(super) fn packed(pixmap: &Pixmap) -> Result<Vec<u8>, FigureError> {
    let packed = pixmap.encode_png();
    packed.map_err(|e| FigureError::Encode(e.to_string()))
}

/// Draws one shape, `scale` pixels to a unit.
pub(super) fn draw(pixmap: &mut Pixmap, shape: &Shape, scale: Transform) {
    for Outline { path, place, ink } in outlines(shape) {
        let place = place.post_concat(scale);
        match ink {
            Ink::Fill { colour, smooth } if has_area(&path) => {
                let paint = paint(colour, smooth);
                pixmap.fill_path(&path, &paint, FillRule::Winding, place, None);
            }
            Ink::Fill { .. } => {}
            Ink::Pen(stroke) => stroke_path(pixmap, &path, stroke, place),
        }
    }
}

/// A path with where it goes, and what it is drawn with.
pub(super) struct Outline {
    pub(super) path: Path,
    pub(super) place: Transform,
    pub(super) ink: Ink,
}

/// What a path is drawn with.
pub(super) enum Ink {
    /// Its inside, with soft edges or with hard ones.
    Fill { colour: Colour, smooth: bool },
    /// Its outline, as wide as the pen.
    Pen(Stroke),
}

/// The outlines of a shape, in the order in which they are drawn.
pub(super) fn outlines(shape: &Shape) -> Vec<Outline> {
    let mut outlines = Vec::new();
    let mut add = |path: Option<Path>, place: Transform, ink: Ink| {
        outlines.extend(path.map(|path| Outline { path, place, ink }));
    };
    let here = Transform::identity();
    let filled = |colour, smooth| Ink::Fill { colour, smooth };
    match shape {
        Shape::Line { points, stroke } => add(polygon(points, false), here, Ink::Pen(*stroke)),
        Shape::Area { points, fill } => add(polygon(points, true), here, filled(*fill, true)),
        Shape::Rects { rects, fill } => {
            let mut path = PathBuilder::new();
            rects.iter().for_each(|it| path.push_rect(path_rect(*it)));
            add(path.finish(), here, filled(*fill, false));
        }
        Shape::Frame { rect, stroke } => {
            let path = PathBuilder::from_rect(path_rect(*rect));
            add(Some(path), here, Ink::Pen(*stroke));
        }
        Shape::Card { rect, fill, border } => {
            add(rounded(*rect), here, filled(*fill, true));
            add(rounded(*rect), here, Ink::Pen(Stroke::solid(*border, 1.0)));
        }
        Shape::Text { at, text, style } => {
            let (path, place) = text_path(*at, text, *style);
            add(path, place, filled(style.colour, true));
        }
    }
    outlines
}

/// Whether there is anything to fill: tiny-skia warns of bars and bands that are flat.
fn has_area(path: &Path) -> bool {
    let bounds = path.bounds();
    bounds.width().min(bounds.height()) > SIDE_MIN
}

fn stroke_path(pixmap: &mut Pixmap, path: &Path, stroke: Stroke, place: Transform) {
    let dash = DASH.map(|length| length as f32).to_vec();
    let dash = StrokeDash::new(dash, 0.0).filter(|_| stroke.dashed);
    let pen = tiny_skia::Stroke {
        width: stroke.width as f32,
        line_cap: LineCap::Butt,
        line_join: LineJoin::Round,
        dash,
        ..tiny_skia::Stroke::default()
    };
    pixmap.stroke_path(path, &paint(stroke.colour, true), &pen, place, None);
}

fn paint(colour: Colour, smooth: bool) -> Paint<'static> {
    let [r, g, b] = colour.rgb;
    let mut paint = Paint::default();
    paint.set_color_rgba8(r, g, b, (colour.alpha * 255.0).round() as u8);
    paint.anti_alias = smooth;
    paint
}

fn polygon(points: &[Point], closed: bool) -> Option<Path> {
    let mut path = PathBuilder::new();
    for (index, &(x, y)) in points.iter().enumerate() {
        match index {
            0 => path.move_to(x as f32, y as f32),
            _ => path.line_to(x as f32, y as f32),
        }
    }
    if closed {
        path.close();
    }
    path.finish()
}

fn path_rect(rect: Rect) -> tiny_skia::Rect {
    let (x, y) = (rect.x as f32, rect.y as f32);
    // A side of 0 is drawn as nothing; sides are sums of finite, ordered numbers.
    let [width, height] = [rect.width, rect.height].map(|side| side.max(0.0) as f32);
    let found = tiny_skia::Rect::from_xywh(x, y, width, height);
    found.unwrap_or_else(|| tiny_skia::Rect::from_xywh(0.0, 0.0, 0.0, 0.0).expect("0 is finite"))
}

fn rounded(rect: Rect) -> Option<Path> {
    let r = CARD_RADIUS as f32;
    let (left, top) = (rect.x as f32, rect.y as f32);
    let (right, bottom) = (rect.right() as f32, rect.bottom() as f32);
    let mut path = PathBuilder::new();
    path.move_to(left + r, top);
    path.line_to(right - r, top);
    path.quad_to(right, top, right, top + r);
    path.line_to(right, bottom - r);
    path.quad_to(right, bottom, right - r, bottom);
    path.line_to(left + r, bottom);
    path.quad_to(left, bottom, left, bottom - r);
    path.line_to(left, top + r);
    path.quad_to(left, top, left + r, top);
    path.close();
    path.finish()
}

/// Outlines of a text from (0, 0), and where they go.
fn text_path((x, y): Point, text: &str, style: TextStyle) -> (Option<Path>, Transform) {
    let mut path = PathBuilder::new();
    font::outline(text, style.size, style.weight, &mut path);
    let width = font::width(text, style.size, style.weight) as f32;
    let back = match style.anchor {
        Anchor::Start => 0.0,
        Anchor::Middle => width / 2.0,
        Anchor::End => width,
    };
    let mut place = Transform::from_translate(-back, 0.0);
    if style.upright {
        place = place.post_rotate(-90.0);
    }
    (path.finish(), place.post_translate(x as f32, y as f32))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_flat_is_not_filled() {
        let area = |points: &[Point]| polygon(points, true).is_some_and(|path| has_area(&path));
        assert!(area(&[(0.0, 0.0), (9.0, 0.0), (9.0, 2.0)]));
        assert!(!area(&[(0.0, 3.0), (9.0, 3.0), (5.0, 3.0)]));
        assert!(!area(&[(4.0, 0.0), (4.0, 8.0), (4.0, 5.0)]));
    }
}
