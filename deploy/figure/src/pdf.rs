//! A canvas as PDF: one page, text as outlines, so that no font is missing wherever it is read.
//! It writes what `png` draws, in the same places, without its pixels.

use std::{collections::BTreeSet, fmt::Write as _, io::Write as _};

use flate2::{Compression, write::ZlibEncoder};
use tiny_skia::{Path, PathSegment, Point};

use super::{
    canvas::{Canvas, DASH, Shape, Stroke},
    colours::Colour,
    png::{Ink, Outline, outlines},
};

/// Points, of which an inch has 72, in a figure's unit, of which it has 96.
const POINTS: f64 = 0.75;

/// The picture as a file. Source: ISO 32000-1, chapters 7 (syntax), 8.4 and 8.5 (graphics state and paths).
pub(super) fn encode(canvas: &Canvas) -> std::io::Result<Vec<u8>> {
    let (width, height) = (canvas.width * POINTS, canvas.height * POINTS);
    let mut page = Page::default();
    // Figures have y downwards.
    page.say(&format!("{POINTS} 0 0 -{POINTS} 0 {height:.2} cm 1 j"));
    canvas.shapes.iter().for_each(|shape| page.draw(shape));
    let mut packed = ZlibEncoder::new(Vec::new(), Compression::default());
    packed.write_all(page.content.as_bytes())?;
    let packed = packed.finish()?;

    let mut states = String::new();
    for percent in &page.alphas {
        let alpha = f64::from(*percent) / 100.0;
        // Writing to a string cannot fail.
        let _ = write!(states, "/A{percent} << /ca {alpha:.2} >> ");
    }
    let objects = [
        "<< /Type /Catalog /Pages 2 0 R >>".to_owned(),
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>".to_owned(),
        format!(
            "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.2} {height:.2}] /Contents 4 0 R \
             /Resources << /ExtGState << {states}>> >> >>"
        ),
        format!(
            "<< /Length {} /Filter /FlateDecode >>\nstream\n",
            packed.len()
        ),
    ];
    let mut file = b"%PDF-1.4\n".to_vec();
    let mut table = format!("xref\n0 {}\n0000000000 65535 f \n", objects.len() + 1);
    for (number, object) in (1..).zip(&objects) {
        let _ = writeln!(table, "{:010} 00000 n ", file.len());
        file.extend(format!("{number} 0 obj\n{object}").bytes());
        if number == objects.len() {
            file.extend(&packed);
            file.extend(b"\nendstream");
        }
        file.extend(b"\nendobj\n");
    }
    let start = file.len();
    file.extend(table.bytes());
    let size = objects.len() + 1;
    file.extend(
        format!("trailer\n<< /Size {size} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n").bytes(),
    );
    Ok(file)
}

/// The operators of a page.
#[derive(Default)]
struct Page {
    content: String,
    /// Percents that fills cover, of those that do not cover all.
    alphas: BTreeSet<u32>,
}

impl Page {
    fn say(&mut self, operators: &str) {
        self.content.push_str(operators);
        self.content.push('\n');
    }

    fn draw(&mut self, shape: &Shape) {
        for Outline { path, place, ink } in outlines(shape) {
            let Some(path) = path.transform(place) else {
                continue;
            };
            let path = operators(&path);
            match ink {
                Ink::Fill { colour, .. } => self.fill(&path, colour),
                Ink::Pen(stroke) => self.stroke(&path, stroke),
            }
        }
    }

    fn fill(&mut self, path: &str, colour: Colour) {
        let percent = (colour.alpha * 100.0).round() as u32;
        let brush = rgb(colour);
        if percent < 100 {
            self.alphas.insert(percent);
            self.say(&format!("q /A{percent} gs {brush} rg {path}f Q"));
        } else {
            self.say(&format!("{brush} rg {path}f"));
        }
    }

    fn stroke(&mut self, path: &str, stroke: Stroke) {
        let dash = match stroke.dashed {
            true => format!("[{} {}]", DASH[0], DASH[1]),
            false => "[]".to_owned(),
        };
        let (pen, width) = (rgb(stroke.colour), stroke.width);
        self.say(&format!("{pen} RG {width} w {dash} 0 d {path}S"));
    }
}

fn rgb(colour: Colour) -> String {
    let [r, g, b] = colour.rgb.map(|part| f64::from(part) / 255.0);
    format!("{r:.3} {g:.3} {b:.3}")
}

fn operators(path: &Path) -> String {
    let mut out = String::new();
    let mut last = Point::zero();
    for segment in path.segments() {
        // Writing to a string cannot fail.
        let _ = match segment {
            PathSegment::MoveTo(to) => write!(out, "{} m ", point(to)),
            PathSegment::LineTo(to) => write!(out, "{} l ", point(to)),
            PathSegment::QuadTo(by, to) => {
                // The cubic of the same curve.
                let near = |end: Point| {
                    let part = |end: f32, by: f32| end + (by - end) * 2.0 / 3.0;
                    point(Point::from_xy(part(end.x, by.x), part(end.y, by.y)))
                };
                write!(out, "{} {} {} c ", near(last), near(to), point(to))
            }
            PathSegment::CubicTo(by, then, to) => {
                write!(out, "{} {} {} c ", point(by), point(then), point(to))
            }
            PathSegment::Close => write!(out, "h "),
        };
        last = match segment {
            PathSegment::MoveTo(to)
            | PathSegment::LineTo(to)
            | PathSegment::QuadTo(_, to)
            | PathSegment::CubicTo(_, _, to) => to,
            PathSegment::Close => last,
        };
    }
    out
}

fn point(it: Point) -> String {
    format!("{:.2} {:.2}", it.x, it.y)
}
