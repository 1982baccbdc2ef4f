//! Draws charts, heat maps and lattices on a light card, and encodes them as SVG, PDF or PNG from one description.
//!
//! Start with [`Figure`]: a title, notes, and panels in a grid. Each panel is a [`Chart`], a [`Heat`] map or a [`Lattice`]. The same
//! figure gives the same bytes on every machine because the font is built in. A [`Film`] is a sequence of [`Picture`]s, written as a
//! GIF. The crate knows nothing about runs and experiments.
//!
//! ```
//! use driml_figure::{Axis, Chart, Figure, Format, Look, Panel, Series};
//!
//! let curve = Series::line("driml-ada", 0, vec![(0.0, 1.0), (50_000.0, 4.5), (100_000.0, 9.0)]);
//! let chart = Chart::new(
//!     "coinrun",
//!     Axis::linear("frames"),
//!     Axis::linear("mean return"),
//!     vec![curve],
//! );
//! let figure = Figure {
//!     title: "Training return".into(),
//!     notes: vec!["Mean of the last 100 episodes.".into()],
//!     columns: 1,
//!     panel_size: (430.0, 330.0),
//!     panels: vec![Panel::Chart(chart)],
//! };
//! let svg = figure.encode(Format::Svg, Look::Card)?;
//! assert!(svg.starts_with(b"<svg "));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod canvas;
mod chart;
mod colours;
mod figure;
mod film;
mod font;
mod heat;
mod lattice;
mod picture;
mod render;
mod ticks;

pub use crate::{
    canvas::Rect,
    chart::{Axis, Chart, Mark, Series},
    colours::{Colour, GREY},
    figure::{Figure, Format, Look, Panel},
    film::Film,
    heat::{Field, Heat},
    lattice::Lattice,
    picture::{Ink, Picture},
    render::FigureError,
};
