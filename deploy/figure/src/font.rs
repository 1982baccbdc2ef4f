//! Widths and outlines of text in the built-in font (DejaVu Sans, which has an open licence).
//! Kerning and right-to-left scripts are not supported: figures are in English.

use std::{fmt::Write as _, sync::LazyLock};

use ttf_parser::{Face, OutlineBuilder};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Weight {
    Regular,
    Bold,
}

/// The faces, in the order of [`Weight`].
static FACES: LazyLock<[Face<'static>; 2]> = LazyLock::new(|| {
    let fonts = [dejavu::sans::regular(), dejavu::sans::bold()];
    fonts.map(|font| Face::parse(font, 0).expect("the font is built in, and a test reads it"))
});

impl Weight {
    fn face(self) -> &'static Face<'static> {
        &FACES[self as usize]
    }
}

pub(super) fn width(text: &str, size: f64, weight: Weight) -> f64 {
    let face = weight.face();
    let units: f64 = text.chars().map(|c| advance(face, c)).sum();
    units * size / f64::from(face.units_per_em())
}

/// Returns the width of the widest of these texts in regular weight.
pub(super) fn max_width<'a>(texts: impl IntoIterator<Item = &'a String>, size: f64) -> f64 {
    let texts = texts.into_iter();
    let widths = texts.map(|text| width(text, size, Weight::Regular));
    widths.fold(0.0, f64::max)
}

fn advance(face: &Face<'_>, c: char) -> f64 {
    let glyph = face.glyph_index(c).unwrap_or_default();
    f64::from(face.glyph_hor_advance(glyph).unwrap_or_default())
}

/// Cuts `text` to fit `width_max`, and adds an ellipsis if anything was cut. Empty if not even the ellipsis fits.
pub(super) fn fit(text: &str, size: f64, weight: Weight, width_max: f64) -> String {
    if width(text, size, weight) <= width_max {
        return text.to_owned();
    }
    let mut cut: Vec<char> = text.chars().collect();
    while cut.pop().is_some() {
        let shorter: String = cut.iter().collect::<String>() + "\u{2026}";
        if width(&shorter, size, weight) <= width_max {
            return shorter;
        }
    }
    String::new()
}

/// Breaks `text` at spaces into lines of at most `width_max`, measured in bold. A longer word gets a separate line and is cut.
pub(super) fn wrap(text: &str, size: f64, width_max: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        let longer = lines.last().map(|line| format!("{line} {word}"));
        match longer {
            Some(longer) if width(&longer, size, Weight::Bold) <= width_max => {
                lines.pop();
                lines.push(longer);
            }
            _ => lines.push(fit(word, size, Weight::Bold, width_max)),
        }
    }
    lines
}

/// Returns the outlines of a line of text as an SVG path that starts at (`left`, 0), with y pointing downwards.
pub(super) fn outline(text: &str, size: f64, weight: Weight, left: f64) -> String {
    let face = weight.face();
    let mut pen = Pen {
        path: String::new(),
        x: left as f32,
        scale: size as f32 / f32::from(face.units_per_em()),
    };
    for c in text.chars() {
        face.outline_glyph(face.glyph_index(c).unwrap_or_default(), &mut pen);
        pen.x += advance(face, c) as f32 * pen.scale;
    }
    pen.path
}

struct Pen {
    path: String,
    x: f32,
    scale: f32,
}

impl Pen {
    fn add(&mut self, command: char, points: &[(f32, f32)]) {
        self.path.push(command);
        for (x, y) in points {
            let (x, y) = (self.x + x * self.scale, -y * self.scale);
            // Writing to a string cannot fail.
            let _ = write!(self.path, "{x:.2} {y:.2} ");
        }
    }
}

impl OutlineBuilder for Pen {
    fn move_to(&mut self, x: f32, y: f32) {
        self.add('M', &[(x, y)]);
    }

    fn line_to(&mut self, x: f32, y: f32) {
        self.add('L', &[(x, y)]);
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        self.add('Q', &[(x1, y1), (x, y)]);
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        self.add('C', &[(x1, y1), (x2, y2), (x, y)]);
    }

    fn close(&mut self) {
        self.path.push('Z');
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_letter_that_figures_use_is_there() {
        for c in "abcxyzABCXYZ0123456789 .,:;-+*/()[]%\u{3b1}\u{3b5}\u{3bb}\u{3c1}\u{2026}\u{b1}\u{b7}\u{2212}".chars()
        {
            assert!(Weight::Regular.face().glyph_index(c).is_some(), "{c}");
            assert!(Weight::Bold.face().glyph_index(c).is_some(), "{c}");
        }
    }

    #[test]
    fn long_text_is_cut_or_broken_to_fit() {
        let text = "mean return of the last hundred episodes";
        let cut = fit(text, 12.0, Weight::Regular, 100.0);
        assert!(cut.ends_with('\u{2026}') && width(&cut, 12.0, Weight::Regular) <= 100.0);
        assert_eq!(fit("k", 12.0, Weight::Regular, 100.0), "k");
        let lines = wrap(text, 12.0, 120.0);
        assert!(lines.len() > 2);
        assert_eq!(lines.join(" "), text);
        let mut widths = lines.iter().map(|line| width(line, 12.0, Weight::Bold));
        assert!(widths.all(|width| width <= 120.0));
    }
}
