//! A figure: panels in a grid under a title, and its bytes as a file. The caller writes the file.

use std::path::Path;

use crate::{
    canvas::{Anchor, Canvas, Letters, Rect, TextStyle},
    chart::{Chart, Series, draw_legend, legend_height},
    colours::{CARD, CARD_BORDER, INK, INK_SOFT},
    font,
    heat::Heat,
    lattice::Lattice,
    render::{self, FigureError},
};

/// PNG pixels for each unit of the figure: enough for a sharp picture on a dense screen and in print.
const PNG_ZOOM: f32 = 1.5;
const MARGIN: f64 = 18.0;
const TITLE_SIZE: f64 = 17.0;
const NOTE_SIZE: f64 = 12.5;
const NOTE_LEADING: f64 = 17.0;
/// The share of a panel that the legend of a chart may take: two rows of a small panel. More rows would leave no room for the y label.
const LEGEND_SHARE_MAX: f64 = 0.16;

/// One panel of a figure.
#[derive(Debug)]
pub enum Panel {
    /// Lines, points and bands over two axes.
    Chart(Chart),
    /// A matrix, drawn as colours.
    Heat(Heat),
    /// A square grid of black and white cells.
    Lattice(Lattice),
}

/// Panels in a grid under a title.
#[derive(Debug)]
pub struct Figure {
    /// The title above the panels.
    pub title: String,
    /// Lines under the title that say how the numbers were made.
    pub notes: Vec<String>,
    /// The number of panels in a row.
    pub columns: usize,
    /// Width and height of each panel, in figure units.
    pub panel_size: (f64, f64),
    /// The panels, row by row.
    pub panels: Vec<Panel>,
}

/// The file format of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Vector graphics with text as text.
    Svg,
    /// Vector graphics with text as outlines.
    Pdf,
    /// Pixels, with text in the built-in font.
    Png,
}

impl Format {
    /// Returns the format for the file's extension: `.svg`, `.pdf` or `.png`.
    pub fn from_path(path: &Path) -> Result<Self, FigureError> {
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("svg") => Ok(Self::Svg),
            Some("pdf") => Ok(Self::Pdf),
            Some("png") => Ok(Self::Png),
            _ => Err(FigureError(format!(
                "{} is not the name of a picture: use one that ends in .svg, .pdf or .png",
                path.display()
            ))),
        }
    }
}

/// What is drawn around the panels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Look {
    /// A card with title and notes, and a legend in each chart: for a screen, where no caption explains the figure.
    Card,
    /// The panels alone, with one legend: for a paper, whose caption explains the rest.
    Plain,
}

impl Figure {
    /// Returns the bytes of a file in this format.
    pub fn encode(&self, format: Format, look: Look) -> Result<Vec<u8>, FigureError> {
        let svg = |letters| self.draw(look, letters).svg();
        match format {
            Format::Svg => Ok(svg(Letters::Text).into_bytes()),
            Format::Pdf => render::pdf(&svg(Letters::Outlines)),
            Format::Png => render::png(&svg(Letters::Outlines), PNG_ZOOM),
        }
    }

    /// Returns the series of one legend for all charts, each name once, if a chart's legend would take too much of its panel, or if the
    /// only legend would lack a series.
    fn shared_legend(&self, look: Look) -> Vec<&Series> {
        let legends = self.panels.iter().map(|panel| match panel {
            Panel::Chart(chart) => chart.named_series(),
            Panel::Heat(_) | Panel::Lattice(_) => Vec::new(),
        });
        let legends: Vec<Vec<&Series>> = legends.collect();
        let (width, height) = self.panel_size;
        let height_max = LEGEND_SHARE_MAX * height;
        let is_large = |it: &Vec<&Series>| legend_height(width, it) > height_max;
        let mut shared: Vec<&Series> = Vec::new();
        for series in legends.iter().flatten() {
            if shared.iter().all(|it| it.name != series.name) {
                shared.push(series);
            }
        }
        let is_in_first = |it: &&Series| legends[0].iter().any(|first| first.name == it.name);
        let lacks_a_name = look == Look::Plain && !shared.iter().all(is_in_first);
        let is_needed = lacks_a_name || legends.iter().any(is_large);
        if is_needed { shared } else { Vec::new() }
    }

    fn draw(&self, look: Look, letters: Letters) -> Canvas {
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let rows = self.panels.len().div_ceil(columns);
        let (panel_width, panel_height) = self.panel_size;
        let width = MARGIN + columns as f64 * (panel_width + MARGIN);
        let lines = |note: &String| font::wrap(note, NOTE_SIZE, width - 2.0 * MARGIN);
        let notes: Vec<String> = self.notes.iter().flat_map(lines).collect();
        let mut header_height = match look {
            Look::Card => MARGIN + TITLE_SIZE + 16.0 + notes.len() as f64 * NOTE_LEADING,
            Look::Plain => MARGIN,
        };
        let shared = self.shared_legend(look);
        let legend = Rect::new(MARGIN, header_height, width - 2.0 * MARGIN, 0.0);
        if !shared.is_empty() {
            header_height += legend_height(legend.width, &shared) + 10.0;
        }
        let height = header_height + rows as f64 * (panel_height + MARGIN) + 4.0;

        let mut canvas = Canvas::new(width, height, letters);
        match look {
            Look::Card => self.draw_header(&mut canvas, &notes),
            Look::Plain => canvas.rects(&[Rect::new(0.0, 0.0, width, height)], CARD),
        }
        draw_legend(&mut canvas, legend, &shared);
        for (index, panel) in self.panels.iter().enumerate() {
            let (row, column) = ((index / columns) as f64, (index % columns) as f64);
            let x = MARGIN + column * (panel_width + MARGIN);
            let y = header_height + row * (panel_height + MARGIN);
            let area = Rect::new(x, y, panel_width, panel_height);
            match panel {
                Panel::Chart(chart) => {
                    let legend = shared.is_empty() && (look == Look::Card || index == 0);
                    let title = look == Look::Card || self.panels.len() > 1;
                    chart.draw(&mut canvas, area, title, legend);
                }
                Panel::Heat(heat) => heat.draw(&mut canvas, area),
                Panel::Lattice(lattice) => lattice.draw(&mut canvas, area),
            }
        }
        canvas
    }

    fn draw_header(&self, canvas: &mut Canvas, notes: &[String]) {
        let (width, height) = (canvas.width, canvas.height);
        let whole = Rect::new(0.5, 0.5, width - 1.0, height - 1.0);
        canvas.card(whole, CARD, CARD_BORDER);
        let title = TextStyle::new(TITLE_SIZE, INK, Anchor::Start).bold();
        let title = title.cut_at(width - 2.0 * MARGIN);
        canvas.text((MARGIN, MARGIN + TITLE_SIZE - 3.0), &self.title, title);
        for (line, note) in notes.iter().enumerate() {
            let y = MARGIN + TITLE_SIZE + 4.0 + (line + 1) as f64 * NOTE_LEADING - 4.0;
            let style = TextStyle::new(NOTE_SIZE, INK_SOFT, Anchor::Start);
            canvas.text((MARGIN, y), note, style);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{Axis, Series};

    fn figure() -> Figure {
        let line = Series::line("one & two", 0, vec![(0.0, 1.0), (10_000.0, 3.0)]);
        let series = vec![line, Series::line("none", 1, vec![])];
        let (x, y) = (Axis::linear("frames"), Axis::linear("return"));
        let chart = Chart::new("returns", x, y, series);
        let heat = Heat::new("A", 2, vec![0.0, 1.0, f64::NAN, 0.5]);
        let lattice = Lattice {
            title: "spins".into(),
            side: 2,
            dark: vec![true, false, false, true],
            outline: None,
        };
        Figure {
            title: "A figure".into(),
            notes: vec!["made up".into()],
            columns: 2,
            panel_size: (320.0, 260.0),
            panels: vec![
                Panel::Chart(chart),
                Panel::Heat(heat),
                Panel::Lattice(lattice),
            ],
        }
    }

    #[test]
    fn every_format_is_encoded_and_the_same_every_time() {
        for (name, start, inside) in [
            ("a.svg", "<svg ", "one &amp; two"),
            // 694 units of 1/96 inch, in points.
            ("a.pdf", "%PDF-1.7", "/MediaBox [0 0 520.5 "),
            ("a.png", "\u{89}PNG", "IHDR"),
        ] {
            let encode = || -> String {
                let format = Format::from_path(Path::new(name)).unwrap();
                let bytes = figure().encode(format, Look::Card).unwrap();
                bytes.into_iter().map(char::from).collect()
            };
            let text = encode();
            let is_whole = text.starts_with(start) && text.contains(inside);
            assert!(is_whole && !text.contains("NaN"), "{name}");
            assert!(text == encode(), "{name}");
        }
    }

    fn chart(title: &str, names: &[String]) -> Panel {
        let points = || vec![(0.0, 1.0), (1.0, 3.0)];
        let lines = names.iter().map(|name| Series::line(name, 0, points()));
        let (x, y) = (Axis::linear("frames"), Axis::linear("return"));
        Panel::Chart(Chart::new(title, x, y, lines.collect()))
    }

    fn svg(panels: Vec<Panel>, look: Look) -> String {
        let bytes = Figure { panels, ..figure() }.encode(Format::Svg, look);
        String::from_utf8(bytes.unwrap()).unwrap()
    }

    #[test]
    fn a_legend_that_would_fill_a_panel_is_above_all_panels() {
        for (runs, entries) in [(2, 4), (3, 3), (20, 20)] {
            let name = |at| format!("a run with a long name {at:02}");
            let names: Vec<_> = (0..runs).map(name).collect();
            let svg = svg(vec![chart("", &names), chart("", &names)], Look::Card);
            assert_eq!(svg.matches("a run with").count(), entries);
        }
    }

    #[test]
    fn a_plain_figure_is_its_panels_and_one_legend() {
        let names = ["driml-ada", "c51"].map(String::from);
        let panels = || vec![chart("first", &names[..1]), chart("second", &names)];
        let (card, plain) = (svg(panels(), Look::Card), svg(panels(), Look::Plain));
        for (word, in_card, in_plain) in [
            ("A figure", 1, 0),
            ("made up", 1, 0),
            ("rx=", 1, 0),
            ("driml-ada", 2, 1),
            ("c51", 1, 1),
            ("second", 1, 1),
        ] {
            let found = [&card, &plain].map(|svg| svg.matches(word).count());
            assert_eq!(found, [in_card, in_plain], "{word}");
        }
    }
}
