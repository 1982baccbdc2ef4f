//! A chart: series as lines, points and bands over two axes. The legend is above the plot, so that it hides no data.
//! The chart computes no statistics: the caller decides what a band means.

use super::{
    canvas::{Anchor, Canvas, Letters, Point, Rect, TextStyle, draw_title},
    colours::{Colour, GRID, INK, INK_SOFT, SERIES_COLOURS, series_colour},
    font::{self, Weight},
    ticks,
};

const LABEL_SIZE: f64 = 12.5;
const TICK_SIZE: f64 = 11.5;
const LEGEND_SIZE: f64 = 12.0;
const LEGEND_LEADING: f64 = 18.0;
const LEGEND_MARK: f64 = 22.0;
const BAND_ALPHA: f32 = 0.18;
const LINE_WIDTH: f64 = 1.8;
const DOT_RADIUS: f64 = 3.0;
const RING_RADIUS: f64 = 5.0;
/// The share of an axis's range that stays free at each end.
const SLACK: f64 = 0.05;

/// One axis of a chart: its label, its scale (linear, logarithmic or names) and the values that it must cover.
#[derive(Clone, Debug, Default)]
pub struct Axis {
    label: String,
    /// Whether the axis is logarithmic. Values of 0 and below are then left out.
    is_log: bool,
    /// Values that the axis always covers, whatever values the series have.
    covered: Vec<f64>,
    /// Names for the values 0, 1, 2, ..., written instead of numbers. Empty if the axis has numbers.
    names: Vec<String>,
}

impl Axis {
    /// Creates a linear axis.
    pub fn linear(label: &str) -> Self {
        Self {
            label: label.to_owned(),
            ..Self::default()
        }
    }

    /// Creates an axis of names: the first name is at 0, the next at 1.
    pub fn names(label: &str, names: &[String]) -> Self {
        let last = names.len().saturating_sub(1) as f64;
        Self {
            names: names.to_vec(),
            ..Self::linear(label).covering(&[-0.5, last + 0.5])
        }
    }

    /// Creates a logarithmic axis.
    pub fn log(label: &str) -> Self {
        Self {
            is_log: true,
            ..Self::linear(label)
        }
    }

    /// Returns the same axis, which also covers these values.
    pub fn covering(mut self, values: &[f64]) -> Self {
        self.covered.extend(values);
        self
    }

    fn shows(&self, value: f64) -> bool {
        value.is_finite() && (!self.is_log || value > 0.0)
    }

    /// Maps a value to the scale of the axis: the value itself, or its decimal logarithm.
    fn transform(&self, value: f64) -> f64 {
        if self.is_log { value.log10() } else { value }
    }

    /// Returns the axis's range for these values, widened by `slack`; `None` without values.
    fn scale(&self, values: impl Iterator<Item = f64>, slack: f64) -> Option<Scale<'_>> {
        let all = values.chain(self.covered.iter().copied());
        let kept = all.filter(|value| self.shows(*value));
        let (low, high) = ticks::bounds(kept.map(|value| self.transform(value)))?;
        // Means of equal values may differ by a rounding error.
        let margin = match (high - low) * slack {
            margin if margin <= 1e-12 * high.abs() => low.abs().max(1.0) * SLACK,
            margin => margin,
        };
        Some(Scale {
            axis: self,
            low: low - margin,
            high: high + margin,
        })
    }
}

/// An axis with its range: `low` and `high` are the values at the ends, after [`Axis::transform`].
struct Scale<'a> {
    axis: &'a Axis,
    low: f64,
    high: f64,
}

impl Scale<'_> {
    /// Returns the position of a value along the axis, in 0..=1 for values within the range.
    fn position(&self, value: f64) -> f64 {
        (self.axis.transform(value) - self.low) / (self.high - self.low)
    }

    /// Returns the tick values and their labels for an axis of this length: about one tick every `spacing` units.
    fn ticks(&self, length: f64, spacing: f64) -> Vec<(f64, String)> {
        let ticks = match (&self.axis.names[..], self.axis.is_log) {
            ([], true) => ticks::log(10f64.powf(self.low), 10f64.powf(self.high)),
            ([], false) => ticks::linear(self.low, self.high, (length / spacing).max(2.0) as usize),
            (names, _) => {
                let positions = (0_u32..).map(f64::from);
                return positions.zip(names.iter().cloned()).collect();
            }
        };
        let labels = ticks::labels(&ticks);
        ticks.into_iter().zip(labels).collect()
    }
}

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// A line through the points.
    Line,
    /// A dashed line through the points.
    Dashed,
    /// Open circles, so that points of another series inside them stay visible.
    Rings,
    /// The points, each with a vertical bar from the low to the high end of its band.
    Bars,
}

/// Points that share one colour and one legend entry.
#[derive(Clone, Debug)]
pub struct Series {
    /// The legend entry; empty if the series has none.
    pub name: String,
    /// The colour of the marks and of the legend entry.
    pub colour: Colour,
    /// How the points are drawn.
    pub mark: Mark,
    /// The points (x, y), sorted by x.
    pub points: Vec<(f64, f64)>,
    /// The band (x, low, high), sorted by x; empty if the series has none. At a single x it is a bar.
    pub band: Vec<(f64, f64, f64)>,
}

impl Series {
    /// Creates a line in the colour of this index. Lines of the second round of colours are dashed.
    pub fn line(name: &str, index: usize, points: Vec<(f64, f64)>) -> Self {
        Self {
            name: name.to_owned(),
            colour: series_colour(index),
            mark: match (index / SERIES_COLOURS) % 2 {
                0 => Mark::Line,
                _ => Mark::Dashed,
            },
            points,
            band: Vec::new(),
        }
    }

    /// Returns the same series with another mark.
    pub fn with_mark(mut self, mark: Mark) -> Self {
        self.mark = mark;
        self
    }

    /// Returns the same series in another colour.
    pub fn with_colour(mut self, colour: Colour) -> Self {
        self.colour = colour;
        self
    }

    /// Returns the same series with a band.
    pub fn with_band(mut self, band: Vec<(f64, f64, f64)>) -> Self {
        self.band = band;
        self
    }

    fn draw_marks(&self, canvas: &mut Canvas, points: &[Point]) {
        let (colour, has_length) = (self.colour, points.len() > 1);
        match self.mark {
            Mark::Line if has_length => canvas.line(points, colour, LINE_WIDTH),
            Mark::Dashed if has_length => canvas.dashed_line(points, colour, LINE_WIDTH),
            Mark::Rings => {
                let ring = |point: &Point| canvas.ring(*point, RING_RADIUS, colour);
                points.iter().for_each(ring);
            }
            // A line of one point would be invisible, so draw a dot.
            Mark::Bars | Mark::Line | Mark::Dashed => {
                let dot = |point: &Point| canvas.dot(*point, DOT_RADIUS, colour);
                points.iter().for_each(dot);
            }
        }
    }
}

/// Series over two axes, with a title and a legend.
#[derive(Debug)]
pub struct Chart {
    title: String,
    x: Axis,
    y: Axis,
    series: Vec<Series>,
}

impl Chart {
    /// Creates a chart of these series. Later series lie on top of earlier ones.
    pub fn new(title: &str, x: Axis, y: Axis, series: Vec<Series>) -> Self {
        Self {
            title: title.to_owned(),
            x,
            y,
            series,
        }
    }

    pub(super) fn draw(&self, canvas: &mut Canvas, mut area: Rect, title: bool, legend: bool) {
        if title {
            area = draw_title(canvas, area, &self.title);
        }
        if legend {
            let height = draw_legend(canvas, area, &self.named_series());
            area = Rect::new(area.x, area.y + height, area.width, area.height - height);
        }
        let points = || self.series.iter().flat_map(|series| &series.points);
        let bands = || self.series.iter().flat_map(|series| &series.band);
        let xs = points().map(|point| point.0);
        let ends = bands().flat_map(|(_, low, high)| [*low, *high]);
        let ys = points().map(|point| point.1).chain(ends);
        let (Some(x), Some(y)) = (self.x.scale(xs, SLACK / 2.0), self.y.scale(ys, SLACK)) else {
            let middle = (area.x + area.width / 2.0, area.y + area.height / 2.0);
            canvas.text(middle, "no values yet", soft(LABEL_SIZE, Anchor::Middle));
            return;
        };

        let below = TICK_SIZE + LABEL_SIZE + 16.0;
        let y_ticks = y.ticks(area.height - below, 42.0);
        let y_labels = y_ticks.iter().map(|(_, label)| label);
        let left = font::max_width(y_labels, TICK_SIZE) + LABEL_SIZE + 18.0;
        let (width, height) = (area.width - left - 8.0, area.height - below - 4.0);
        let rect = Rect::new(area.x + left, area.y + 4.0, width, height);
        let plot = Plot { rect, x, y };
        plot.draw_axes(canvas, &y_ticks, area.x);
        for series in &self.series {
            plot.draw_series(canvas, series);
        }
    }

    /// Returns the series that have a legend entry.
    pub(super) fn named_series(&self) -> Vec<&Series> {
        let named = self.series.iter().filter(|it| !it.name.is_empty());
        named.collect()
    }
}

/// Draws a legend at the top of `area`, in as many rows as it needs, and returns its height.
pub(super) fn draw_legend(canvas: &mut Canvas, area: Rect, all: &[&Series]) -> f64 {
    let (mut x, mut y, mut bottom) = (area.x, area.y, area.y);
    for series in all {
        let name_width_max = area.width - LEGEND_MARK - 6.0;
        let name = font::fit(&series.name, LEGEND_SIZE, Weight::Regular, name_width_max);
        let width = LEGEND_MARK + 6.0 + font::width(&name, LEGEND_SIZE, Weight::Regular) + 16.0;
        if x > area.x && x + width - 16.0 > area.right() {
            x = area.x;
            y += LEGEND_LEADING;
        }
        let middle = y + LEGEND_LEADING / 2.0;
        if !series.band.is_empty() && series.mark != Mark::Bars {
            let patch = Rect::new(x, middle - 5.0, LEGEND_MARK, 10.0);
            canvas.rects(&[patch], series.colour.with_alpha(BAND_ALPHA));
        }
        let ends = [(x, middle), (x + LEGEND_MARK, middle)];
        match series.mark {
            Mark::Line | Mark::Dashed => series.draw_marks(canvas, &ends),
            _ => series.draw_marks(canvas, &[(x + LEGEND_MARK / 2.0, middle)]),
        }
        let at = (x + LEGEND_MARK + 6.0, middle + LEGEND_SIZE * 0.36);
        canvas.text(at, &name, TextStyle::new(LEGEND_SIZE, INK, Anchor::Start));
        x += width;
        bottom = y + LEGEND_LEADING + 4.0;
    }
    bottom - area.y
}

pub(super) fn legend_height(width: f64, all: &[&Series]) -> f64 {
    let mut scratch = Canvas::new(width, 0.0, Letters::Text);
    draw_legend(&mut scratch, Rect::new(0.0, 0.0, width, 0.0), all)
}

struct Plot<'a> {
    rect: Rect,
    x: Scale<'a>,
    y: Scale<'a>,
}

impl Plot<'_> {
    fn point(&self, x: f64, y: f64) -> Point {
        (
            self.rect.x + self.x.position(x) * self.rect.width,
            self.rect.bottom() - self.y.position(y) * self.rect.height,
        )
    }

    fn shows(&self, x: f64, y: f64) -> bool {
        self.x.axis.shows(x) && self.y.axis.shows(y)
    }

    /// Draws the grid, tick labels and axis labels. `left` is the x of the panel's left edge.
    fn draw_axes(&self, canvas: &mut Canvas, y_ticks: &[(f64, String)], left: f64) {
        let plot = self.rect;
        let x_ticks = self.x.ticks(plot.width, 74.0);
        let x_room = match self.x.axis.names.len() {
            0 => f64::INFINITY,
            names => plot.width / names as f64 - 4.0,
        };
        for (tick, label) in &x_ticks {
            let x = self.point(*tick, 1.0).0;
            canvas.line(&[(x, plot.y), (x, plot.bottom())], GRID, 1.0);
            let at = (x, plot.bottom() + TICK_SIZE + 5.0);
            canvas.text(at, label, soft(TICK_SIZE, Anchor::Middle).cut_at(x_room));
        }
        for (tick, label) in y_ticks {
            let y = self.point(1.0, *tick).1;
            canvas.line(&[(plot.x, y), (plot.right(), y)], GRID, 1.0);
            let at = (plot.x - 6.0, y + TICK_SIZE * 0.36);
            canvas.text(at, label, soft(TICK_SIZE, Anchor::End));
        }
        let corner = [
            (plot.x, plot.y),
            (plot.x, plot.bottom()),
            (plot.right(), plot.bottom()),
        ];
        canvas.line(&corner, INK_SOFT, 1.2);
        let ink = TextStyle::new(LABEL_SIZE, INK, Anchor::Middle);
        let y = plot.bottom() + TICK_SIZE + LABEL_SIZE + 12.0;
        let at = (plot.x + plot.width / 2.0, y);
        canvas.text(at, &self.x.axis.label, ink.cut_at(plot.width));
        let at = (left + LABEL_SIZE - 2.0, plot.y + plot.height / 2.0);
        canvas.text(at, &self.y.axis.label, ink.upright().cut_at(plot.height));
    }

    fn draw_series(&self, canvas: &mut Canvas, series: &Series) {
        let is_shown =
            |(x, low, high): &&(f64, f64, f64)| self.shows(*x, *low) && self.shows(*x, *high);
        let band: Vec<_> = series.band.iter().filter(is_shown).collect();
        if series.mark == Mark::Bars || band.len() == 1 {
            for (x, low, high) in band {
                let bar = [self.point(*x, *low), self.point(*x, *high)];
                canvas.line(&bar, series.colour, 1.4);
            }
        } else {
            let low = band.iter().map(|(x, low, _)| self.point(*x, *low));
            let high = band.iter().rev().map(|(x, _, high)| self.point(*x, *high));
            let rim: Vec<Point> = low.chain(high).collect();
            canvas.polygon(&rim, series.colour.with_alpha(BAND_ALPHA));
        }
        let shown = series.points.iter().filter(|(x, y)| self.shows(*x, *y));
        let points: Vec<Point> = shown.map(|(x, y)| self.point(*x, *y)).collect();
        series.draw_marks(canvas, &points);
    }
}

const fn soft(size: f64, anchor: Anchor) -> TextStyle {
    TextStyle::new(size, INK_SOFT, anchor)
}
