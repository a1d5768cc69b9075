//! Line charts as SVG, for benchmarks.

use std::path::Path;

use plotters::prelude::*;
use plotters::style::FontTransform;
use thiserror::Error;

use super::atomic::{WriteError, write_atomically};

/// One line of a chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Points (x, y); those that are not finite are left out.
    pub points: Vec<(f64, f64)>,
}

/// Why a chart cannot be drawn.
#[derive(Debug, Error)]
pub enum PlotError {
    /// The operating system reported an error.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// No finite point in any series.
    #[error("chart {title:?} has nothing to show: no series has a finite point")]
    Empty {
        /// Title of the chart.
        title: String,
    },
    /// The drawing library reported an error.
    #[error("chart {title:?} cannot be drawn: {message}")]
    Draw {
        /// Title of the chart.
        title: String,
        /// Message of the library.
        message: String,
    },
}

/// Colors that people with red-green color blindness can distinguish [Okabe & Ito 2008].
const COLORS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(60, 60, 60),
    RGBColor(150, 110, 60),
];
const SIZE: (u32, u32) = (860, 520);
const TITLE_SIZE: u32 = 16;
/// Characters per line of the title. A character is about half as wide as high.
const TITLE_LINE: usize = 100;

/// [`line_chart`] as text.
///
/// # Errors
/// There is nothing to draw.
pub fn line_chart_svg(title: &str, x_label: &str, y_label: &str, series: &[Series]) -> Result<String, PlotError> {
    draw(title, x_label, y_label, series)
}

/// Draws lines with a dot at every point into the SVG file `path`. The y axis starts at 0 unless a value is negative.
pub fn line_chart(path: &Path, title: &str, x_label: &str, y_label: &str, series: &[Series]) -> Result<(), PlotError> {
    let svg = draw(title, x_label, y_label, series)?;
    write_atomically(path, |out| out.write_all(svg.as_bytes()))?;
    Ok(())
}

fn draw(title: &str, x_label: &str, y_label: &str, series: &[Series]) -> Result<String, PlotError> {
    let finite = |s: &Series| -> Vec<(f64, f64)> {
        s.points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite()).collect()
    };
    let all: Vec<(f64, f64)> = series.iter().flat_map(finite).collect();
    if all.is_empty() {
        return Err(PlotError::Empty { title: title.to_string() });
    }
    let (x0, x1) = padded(all.iter().map(|p| p.0));
    let (y0, y1) = padded(all.iter().map(|p| p.1).chain([0.0]));
    let y0 = if all.iter().all(|p| p.1 >= 0.0) { 0.0 } else { y0 };

    let failed = |e: &dyn std::fmt::Display| PlotError::Draw { title: title.to_string(), message: e.to_string() };
    let mut svg = String::new();
    {
        let mut area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        area.fill(&WHITE).map_err(|e| failed(&e))?;
        for line in title_lines(title) {
            area = area.titled(&line, ("sans-serif", TITLE_SIZE)).map_err(|e| failed(&e))?;
        }
        let mut chart = ChartBuilder::on(&area)
            .margin(16)
            .x_label_area_size(44)
            .y_label_area_size(70)
            .build_cartesian_2d(x0..x1, y0..y1)
            .map_err(|e| failed(&e))?;
        chart
            .configure_mesh()
            .x_desc(x_label)
            .y_desc(y_label)
            .light_line_style(WHITE)
            .bold_line_style(RGBColor(225, 225, 225))
            .label_style(("sans-serif", 14).into_font().transform(FontTransform::None))
            .draw()
            .map_err(|e| failed(&e))?;
        for (i, line) in series.iter().enumerate() {
            let color = COLORS[i % COLORS.len()];
            let points = finite(line);
            chart
                .draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))
                .map_err(|e| failed(&e))?
                .label(line.name.as_str())
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
            chart
                .draw_series(points.into_iter().map(|point| Circle::new(point, 3, color.filled())))
                .map_err(|e| failed(&e))?;
        }
        chart
            .configure_series_labels()
            .position(emptiest_corner(&all, (x0, x1), (y0, y1)))
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(200, 200, 200))
            .label_font(("sans-serif", 14))
            .draw()
            .map_err(|e| failed(&e))?;
        area.present().map_err(|e| failed(&e))?;
    }
    Ok(svg)
}

/// The title, broken into lines of at most [`TITLE_LINE`] characters.
fn title_lines(title: &str) -> Vec<String> {
    let (mut lines, mut line) = (Vec::new(), String::new());
    for word in title.split(' ') {
        if !line.is_empty() && line.chars().count() + word.chars().count() >= TITLE_LINE {
            lines.push(std::mem::take(&mut line));
        }
        line.push_str(if line.is_empty() { "" } else { " " });
        line.push_str(word);
    }
    lines.push(line);
    lines
}

/// The corner of the chart with the fewest points; the legend is placed there.
fn emptiest_corner(points: &[(f64, f64)], x: (f64, f64), y: (f64, f64)) -> SeriesLabelPosition {
    let share = |v: f64, (low, high): (f64, f64)| (v - low) / (high - low);
    let crowd = |right: bool, top: bool| {
        let near = |v: f64, far_end: bool| if far_end { v > 0.6 } else { v < 0.4 };
        points.iter().filter(|p| near(share(p.0, x), right) && near(share(p.1, y), top)).count()
    };
    let corners = [
        (crowd(true, true), SeriesLabelPosition::UpperRight),
        (crowd(false, true), SeriesLabelPosition::UpperLeft),
        (crowd(true, false), SeriesLabelPosition::LowerRight),
        (crowd(false, false), SeriesLabelPosition::LowerLeft),
    ];
    corners.into_iter().min_by_key(|(crowd, _)| *crowd).map_or(SeriesLabelPosition::UpperRight, |(_, corner)| corner)
}

/// Smallest and largest value with a margin.
fn padded(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    let air = if high > low { 0.05 * (high - low) } else { 0.5 * high.abs().max(1.0) };
    (low - air, high + air)
}
