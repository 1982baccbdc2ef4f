//! `driml plot`: what several runs recorded, drawn over each other against frames, as SVG.
//! It reads `metrics.csv` alone and changes no number.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use plotters::prelude::*;

use crate::{cli::PlotArgs, error::usage, print};

/// Size of a picture, pixels.
const SIZE: (u32, u32) = (900, 420);
/// Colours that stay apart in print and for colour-blind readers. Source: Okabe and Ito 2008.
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];

/// One run's curve: (frames, value), in the order of frames.
struct Curve {
    name: String,
    points: Vec<(f64, f64)>,
}

/// Draws one column of the runs' metrics.
///
/// # Errors
/// A folder that is no run's, a column that is not there, a file that cannot be written.
pub(crate) fn run(args: &PlotArgs) -> anyhow::Result<()> {
    let read = |folder: &PathBuf| read(folder, &args.column);
    let curves = args
        .runs
        .iter()
        .map(read)
        .collect::<anyhow::Result<Vec<_>>>()?;
    draw(&args.out, &args.column, &curves)?;
    print(&format!("{}\n", args.out.display()))
}

fn read(folder: &Path, column: &str) -> anyhow::Result<Curve> {
    let path = folder.join("metrics.csv");
    let mut file = csv::Reader::from_path(&path)
        .map_err(|e| usage!("{} is not the folder of a run: {e}", folder.display()))?;
    let header = file
        .headers()
        .with_context(|| format!("reading {}", path.display()))?
        .clone();
    let place = |name: &str| header.iter().position(|field| field == name);
    let frames = place("frames").ok_or_else(|| {
        usage!(
            "{} has no column \"frames\": it is no run's",
            path.display()
        )
    })?;
    let value = place(column).ok_or_else(|| {
        let columns = header.iter().collect::<Vec<_>>().join(", ");
        usage!(
            "{} has no column {column:?}; it has {columns}",
            path.display()
        )
    })?;
    let mut points = Vec::new();
    for (line, row) in file.records().enumerate() {
        let row = row.with_context(|| format!("reading {}", path.display()))?;
        // What was not known yet at a time is empty.
        if row[value].is_empty() {
            continue;
        }
        let number = |text: &str| {
            text.parse::<f64>().map_err(|_| {
                usage!(
                    "{}, row {}: {text:?} is no number",
                    path.display(),
                    line + 2
                )
            })
        };
        points.push((number(&row[frames])?, number(&row[value])?));
    }
    let name = folder
        .file_name()
        .unwrap_or(folder.as_os_str())
        .to_string_lossy()
        .into_owned();
    Ok(Curve { name, points })
}

fn draw(out: &Path, column: &str, curves: &[Curve]) -> anyhow::Result<()> {
    let points = || curves.iter().flat_map(|curve| &curve.points);
    let frames_max = points().map(|point| point.0).fold(1.0, f64::max);
    let low = points().map(|point| point.1).fold(f64::INFINITY, f64::min);
    let high = points()
        .map(|point| point.1)
        .fold(f64::NEG_INFINITY, f64::max);
    if !(low.is_finite() && high.is_finite()) {
        return Err(usage!("none of these runs has a value of {column:?} yet").into());
    }
    let margin = ((high - low) * 0.05).max(1e-3);
    let failed = |e: &dyn std::fmt::Display| anyhow!("drawing {}: {e}", out.display());

    let area = SVGBackend::new(out, SIZE).into_drawing_area();
    area.fill(&WHITE).map_err(|e| failed(&e))?;
    let mut chart = ChartBuilder::on(&area)
        .margin(12)
        .margin_right(36)
        .x_label_area_size(44)
        .y_label_area_size(64)
        .build_cartesian_2d(0.0..frames_max, low - margin..high + margin)
        .map_err(|e| failed(&e))?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .bold_line_style(RGBColor(225, 225, 225))
        .x_desc("frames")
        .y_desc(column.replace('_', " "))
        .x_label_formatter(&|frames| format!("{frames:.0}"))
        .label_style(("sans-serif", 14))
        .draw()
        .map_err(|e| failed(&e))?;
    for (curve, colour) in curves.iter().zip(COLOURS.iter().cycle()) {
        let style = colour.stroke_width(2);
        chart
            .draw_series(LineSeries::new(curve.points.iter().copied(), style))
            .map_err(|e| failed(&e))?
            .label(&curve.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], style));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .background_style(WHITE.mix(0.85))
        .label_font(("sans-serif", 14))
        .draw()
        .map_err(|e| failed(&e))?;
    area.present().map_err(|e| failed(&e))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(text: &str) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("metrics.csv"), text).unwrap();
        folder
    }

    #[test]
    fn rows_without_a_value_are_left_out() {
        let run = folder("frames,mean_return\n0,\n10,1.5\n20,2.5\n");
        let curve = read(run.path(), "mean_return").unwrap();
        assert_eq!(curve.points, [(10.0, 1.5), (20.0, 2.5)]);
        let out = run.path().join("plot.svg");
        draw(&out, "mean_return", &[curve]).unwrap();
        let svg = std::fs::read_to_string(out).unwrap();
        assert!(svg.starts_with("<svg") && svg.contains("<polyline"));
    }

    #[test]
    fn what_cannot_be_drawn_is_said() {
        let run = folder("frames,mean_return\n0,\n");
        let no_column = read(run.path(), "mean").err().unwrap().to_string();
        assert!(no_column.ends_with("has no column \"mean\"; it has frames, mean_return"));
        let curve = read(run.path(), "mean_return").unwrap();
        assert!(draw(&run.path().join("p.svg"), "mean_return", &[curve]).is_err());
        assert!(read(&run.path().join("none"), "mean_return").is_err());
    }
}
