//! A figure: panels in a grid under a title, and the file that it is written to.

use std::path::{Path, PathBuf};

use crate::{
    canvas::{Anchor, Canvas, Rect, TextStyle},
    chart::Chart,
    colours::{CARD, CARD_BORDER, INK, INK_SOFT},
    font::{self, Weight},
    heat::Heat,
    lattice::Lattice,
    png, svg,
};

/// Pixels of a PNG for one unit of the figure: sharp on a dense screen and in print.
const PNG_ZOOM: f32 = 1.5;
/// Space around the panels and between them.
const MARGIN: f64 = 18.0;
const TITLE_SIZE: f64 = 17.0;
const NOTE_SIZE: f64 = 12.5;
const NOTE_LEADING: f64 = 17.0;

/// One part of a figure.
#[derive(Debug)]
pub enum Panel {
    /// Lines, points and bands over two axes.
    Chart(Chart),
    /// A matrix as colours.
    Heat(Heat),
    /// Black and white cells.
    Lattice(Lattice),
}

/// Panels in a grid under a title.
#[derive(Debug)]
pub struct Figure {
    /// What it shows.
    pub title: String,
    /// Lines under the title: how the numbers were made.
    pub notes: Vec<String>,
    /// Panels side by side.
    pub columns: usize,
    /// Width and height of each panel.
    pub panel_size: (f64, f64),
    /// The panels, row by row.
    pub panels: Vec<Panel>,
}

/// What kept a figure from its file.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// The name asks for no kind of picture that there is.
    #[error("{} has no extension of a picture: take a name that ends in .svg or .png", .0.display())]
    Extension(PathBuf),
    /// The picture has no area, or is too large for memory.
    #[error("drawing {}: {why}", .path.display())]
    Draw {
        /// The file that was to be written.
        path: PathBuf,
        /// What is wrong with it.
        why: String,
    },
    /// The name is no film's.
    #[error("{} is no name of a film: take one that ends in .gif", .0.display())]
    NoFilm(PathBuf),
    /// A picture or film of no area, or too large.
    #[error("a picture of {width} x {height} pixels cannot be made")]
    Size {
        /// Pixels across.
        width: usize,
        /// Pixels down.
        height: usize,
    },
    /// A picture cannot be encoded.
    #[error("encoding a picture: {0}")]
    Encode(String),
    /// The file system refused.
    #[error("writing {}", .path.display())]
    Write {
        /// The file that was to be written.
        path: PathBuf,
        /// What the file system said.
        source: std::io::Error,
    },
}

/// The kind of picture that a file's name asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Scalable, with text as text.
    Svg,
    /// Pixels, with the font that comes along.
    Png,
}

impl Format {
    /// By the file's extension.
    ///
    /// # Errors
    /// Any but `.svg` and `.png`.
    pub fn of(path: &Path) -> Result<Self, FigureError> {
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("svg") => Ok(Self::Svg),
            Some("png") => Ok(Self::Png),
            _ => Err(FigureError::Extension(path.to_owned())),
        }
    }
}

impl Figure {
    /// Writes the figure in the format of the file's extension.
    ///
    /// # Errors
    /// Another extension, a file that cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), FigureError> {
        let format = Format::of(path)?;
        let canvas = self.draw();
        let bytes = match format {
            Format::Svg => svg::encode(&canvas).into_bytes(),
            Format::Png => {
                let drawn = png::encode(&canvas, PNG_ZOOM);
                let path = path.to_owned();
                drawn.map_err(|why| FigureError::Draw { path, why })?
            }
        };
        let path = path.to_owned();
        std::fs::write(&path, bytes).map_err(|source| FigureError::Write { path, source })
    }

    /// Writes `folder/stem.svg` and `folder/stem.png`.
    ///
    /// # Errors
    /// Files that cannot be written.
    pub fn save_both(&self, folder: &Path, stem: &str) -> Result<(), FigureError> {
        let path = |extension: &str| -> PathBuf { folder.join(format!("{stem}.{extension}")) };
        self.save(&path("svg"))?;
        self.save(&path("png"))
    }

    fn draw(&self) -> Canvas {
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let rows = self.panels.len().div_ceil(columns);
        let (panel_width, panel_height) = self.panel_size;
        let width = MARGIN + columns as f64 * (panel_width + MARGIN);
        let notes: Vec<String> = self
            .notes
            .iter()
            .flat_map(|note| font::wrap(note, NOTE_SIZE, width - 2.0 * MARGIN))
            .collect();
        let head = MARGIN + TITLE_SIZE + 16.0 + notes.len() as f64 * NOTE_LEADING;
        let height = head + rows as f64 * (panel_height + MARGIN) + 4.0;

        let mut canvas = Canvas::new(width, height);
        canvas.card(
            Rect::new(0.5, 0.5, width - 1.0, height - 1.0),
            CARD,
            CARD_BORDER,
        );
        let style = |size, weight, colour| TextStyle {
            size,
            weight,
            colour,
            anchor: Anchor::Start,
            upright: false,
        };
        let title = style(TITLE_SIZE, Weight::Bold, INK);
        canvas.text(
            (MARGIN, MARGIN + TITLE_SIZE - 3.0),
            &font::fit(&self.title, TITLE_SIZE, Weight::Bold, width - 2.0 * MARGIN),
            title,
        );
        for (line, note) in notes.iter().enumerate() {
            let y = MARGIN + TITLE_SIZE + 4.0 + (line + 1) as f64 * NOTE_LEADING - 4.0;
            canvas.text(
                (MARGIN, y),
                note,
                style(NOTE_SIZE, Weight::Regular, INK_SOFT),
            );
        }
        for (index, panel) in self.panels.iter().enumerate() {
            let (row, column) = ((index / columns) as f64, (index % columns) as f64);
            let place = Rect::new(
                MARGIN + column * (panel_width + MARGIN),
                head + row * (panel_height + MARGIN),
                panel_width,
                panel_height,
            );
            match panel {
                Panel::Chart(chart) => chart.draw(&mut canvas, place),
                Panel::Heat(heat) => heat.draw(&mut canvas, place),
                Panel::Lattice(lattice) => lattice.draw(&mut canvas, place),
            }
        }
        canvas
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{Axis, Series};

    fn figure() -> Figure {
        let line = Series::line("one & two", 0, vec![(0.0, 1.0), (10_000.0, 3.0)]);
        let chart = Chart::new(
            "returns",
            Axis::linear("frames"),
            Axis::linear("return"),
            vec![line, Series::line("none", 1, vec![])],
        );
        let heat = Heat::new("A", 2, vec![Some(0.0), Some(1.0), None, Some(0.5)]);
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
    fn both_formats_are_written_and_the_same_every_time() {
        let folder = tempfile::tempdir().unwrap();
        figure().save_both(folder.path(), "a").unwrap();
        figure().save_both(folder.path(), "b").unwrap();
        let read = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
        assert_eq!(read("a.svg"), read("b.svg"));
        assert_eq!(read("a.png"), read("b.png"));
        let svg = String::from_utf8(read("a.svg")).unwrap();
        assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n"));
        assert!(svg.contains("one &amp; two") && !svg.contains("NaN"));
        assert!(read("a.png").starts_with(b"\x89PNG"));
    }

    #[test]
    fn text_is_drawn_without_a_font_of_the_machine() {
        let canvas = |text: &str| {
            let mut canvas = Canvas::new(80.0, 30.0);
            let style = TextStyle {
                size: 16.0,
                weight: Weight::Regular,
                colour: INK,
                anchor: Anchor::Start,
                upright: false,
            };
            canvas.text((4.0, 20.0), text, style);
            png::encode(&canvas, 1.0).unwrap()
        };
        assert_ne!(canvas("alpha"), canvas(""));
        assert_ne!(canvas("\u{3b1}"), canvas("\u{3c1}"));
    }

    #[test]
    fn other_extensions_are_refused() {
        for name in ["a.pdf", "a", "svg"] {
            let said = figure().save(Path::new(name)).unwrap_err();
            assert!(matches!(said, FigureError::Extension(_)), "{name}");
        }
    }
}
