//! A canvas as SVG, with text as text and numbers cut to two decimals.
//! It embeds no font: a viewer takes the one that came along, if it has it, or one nearly as wide.

use std::fmt::Write as _;

use super::{
    canvas::{Anchor, CARD_RADIUS, Canvas, DASH, Point, Rect, Shape, Stroke, TextStyle},
    colours::Colour,
    font::Weight,
};

const FONTS: &str = "DejaVu Sans, Verdana, Segoe UI, Helvetica, Arial, sans-serif";

/// The picture as a text that ends with a line's end.
pub(super) fn encode(canvas: &Canvas) -> String {
    let (width, height) = (number(canvas.width), number(canvas.height));
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" font-family=\"{FONTS}\">\n"
    );
    for shape in &canvas.shapes {
        out.push_str(&element(shape));
        out.push('\n');
    }
    out.push_str("</svg>\n");
    out
}

fn element(shape: &Shape) -> String {
    match shape {
        Shape::Line { points, stroke } => format!(
            "<polyline points=\"{}\" fill=\"none\" {} stroke-linejoin=\"round\"/>",
            corners(points),
            pen(*stroke)
        ),
        Shape::Area { points, fill } => {
            format!("<polygon points=\"{}\" {}/>", corners(points), brush(*fill))
        }
        Shape::Rects { rects, fill } => {
            let mut d = String::new();
            for Rect {
                x,
                y,
                width,
                height,
            } in rects
            {
                let (x, y, w, h) = (number(*x), number(*y), number(*width), number(*height));
                // Writing to a string cannot fail.
                let _ = write!(d, "M{x} {y}h{w}v{h}h-{w}z");
            }
            format!(
                "<path d=\"{d}\" {} shape-rendering=\"crispEdges\"/>",
                brush(*fill)
            )
        }
        Shape::Frame { rect, stroke } => {
            format!("<rect {} fill=\"none\" {}/>", sides(*rect), pen(*stroke))
        }
        Shape::Card { rect, fill, border } => format!(
            "<rect {} rx=\"{CARD_RADIUS}\" {} {}/>",
            sides(*rect),
            brush(*fill),
            pen(Stroke::solid(*border, 1.0))
        ),
        Shape::Text { at, text, style } => text_element(*at, text, *style),
    }
}

fn text_element((x, y): Point, text: &str, style: TextStyle) -> String {
    let (x, y) = (number(x), number(y));
    let anchor = match style.anchor {
        Anchor::Start => "",
        Anchor::Middle => " text-anchor=\"middle\"",
        Anchor::End => " text-anchor=\"end\"",
    };
    let weight = match style.weight {
        Weight::Regular => "",
        Weight::Bold => " font-weight=\"bold\"",
    };
    let turn = if style.upright {
        format!(" transform=\"rotate(-90 {x} {y})\"")
    } else {
        String::new()
    };
    let text = text
        .replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;");
    format!(
        "<text x=\"{x}\" y=\"{y}\" font-size=\"{}\" {}{anchor}{weight}{turn}>{text}</text>",
        number(style.size),
        brush(style.colour)
    )
}

fn corners(points: &[Point]) -> String {
    let point = |(x, y): &Point| format!("{},{}", number(*x), number(*y));
    points.iter().map(point).collect::<Vec<_>>().join(" ")
}

fn sides(rect: Rect) -> String {
    format!(
        "x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\"",
        number(rect.x),
        number(rect.y),
        number(rect.width),
        number(rect.height)
    )
}

fn hex(colour: Colour) -> String {
    let [r, g, b] = colour.rgb;
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn brush(colour: Colour) -> String {
    if colour.alpha < 1.0 {
        format!(
            "fill=\"{}\" fill-opacity=\"{:.2}\"",
            hex(colour),
            colour.alpha
        )
    } else {
        format!("fill=\"{}\"", hex(colour))
    }
}

fn pen(stroke: Stroke) -> String {
    let dash = if stroke.dashed {
        format!(" stroke-dasharray=\"{} {}\"", DASH[0], DASH[1])
    } else {
        String::new()
    };
    format!(
        "stroke=\"{}\" stroke-width=\"{}\"{dash}",
        hex(stroke.colour),
        number(stroke.width)
    )
}

/// At most two decimals, none that are 0.
fn number(value: f64) -> String {
    let text = format!("{value:.2}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
