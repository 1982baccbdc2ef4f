//! Figures: charts, heat maps and lattices on a light card, written as SVG or PNG from one description.
//! It knows no run and no experiment, and needs no font, browser or library of the machine.

#![cfg_attr(test, allow(clippy::unwrap_used))]

mod canvas;
mod chart;
mod colours;
mod figure;
mod font;
mod heat;
mod lattice;
mod png;
mod svg;
mod ticks;

pub use crate::{
    chart::{Axis, Chart, Mark, Series},
    colours::{Colour, GREY},
    figure::{Figure, FigureError, Format, Panel},
    heat::{Field, Heat, Outline},
    lattice::Lattice,
};
