//! Timelines as SVG for modeled schedules and simulated runs: a band per rank, boxes over time colored by group, and a
//! legend.

use std::fmt::Write;
use std::path::Path;

use super::atomic::{WriteError, write_atomically};

/// A box: an activity with start and end.
#[derive(Clone, Debug, PartialEq)]
pub struct TimelineBox {
    /// Index of the band.
    pub row: usize,
    /// Strip within the band. Boxes in one strip should not overlap.
    pub lane: usize,
    /// Start, seconds.
    pub start_s: f64,
    /// End, seconds.
    pub end_s: f64,
    /// Text, shown where it fits and as a tooltip.
    pub label: String,
    /// Index into [`Timeline::groups`]; sets the color.
    pub group: usize,
}

/// A timeline.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timeline {
    /// Heading.
    pub title: String,
    /// Further text below the heading, for example that times are modeled.
    pub subtitle: String,
    /// Names of the bands.
    pub rows: Vec<String>,
    /// Names of the groups in the legend.
    pub groups: Vec<String>,
    /// Group that is not an activity; drawn in gray.
    pub faint: Option<usize>,
    /// Boxes in any order.
    pub boxes: Vec<TimelineBox>,
}

const WIDTH: f64 = 1200.0;
const LEFT: f64 = 90.0;
const TOP: f64 = 64.0;
const STRIP: f64 = 18.0;
const LEGEND_COLUMNS: usize = 4;
/// Width of a label's character.
const CHARACTER: f64 = 6.0;
const TICKS: usize = 8;
/// Smallest width of a box, so that it stays visible.
const NARROWEST: f64 = 0.8;

/// Writes the picture to `path`.
pub fn write_timeline(path: &Path, timeline: &Timeline) -> Result<(), WriteError> {
    let svg = timeline_svg(timeline);
    write_atomically(path, |out| out.write_all(svg.as_bytes()))
}

/// The picture as SVG text.
pub fn timeline_svg(timeline: &Timeline) -> String {
    let end_s = timeline.boxes.iter().map(|b| b.end_s).filter(|end| end.is_finite()).fold(0.0, f64::max).max(1e-12);
    let x = |seconds: f64| LEFT + (WIDTH - LEFT - 20.0) * seconds / end_s;
    let strips =
        |row: usize| timeline.boxes.iter().filter(|b| b.row == row).map(|b| b.lane + 1).max().unwrap_or(1) as f64;
    let mut tops = vec![TOP];
    for row in 0..timeline.rows.len() {
        tops.push(tops[row] + strips(row) * STRIP + 6.0);
    }
    let bottom = tops[timeline.rows.len()];
    let legend_rows = timeline.groups.len().div_ceil(LEGEND_COLUMNS) as f64;
    let height = bottom + 40.0 + legend_rows * STRIP;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" font-family=\"sans-serif\" \
         font-size=\"11\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    let mut text = |x: f64, y: f64, more: &str, words: &str| {
        let words = escaped(words);
        // Writing to a String cannot fail.
        let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\"{more}>{words}</text>");
    };
    text(LEFT, 22.0, " font-size=\"15\"", &timeline.title);
    text(LEFT, 40.0, " fill=\"#555\"", &timeline.subtitle);
    for (row, name) in timeline.rows.iter().enumerate() {
        text(6.0, tops[row] + 13.0, "", name);
    }
    for tick in 0..=TICKS {
        let at_s = end_s * tick as f64 / TICKS as f64;
        // The last label ends at the edge of the picture.
        let anchor = if tick == TICKS { " text-anchor=\"end\"" } else { " text-anchor=\"middle\"" };
        text(x(at_s), bottom + 14.0, anchor, &format!("{:.1} us", at_s * 1e6));
    }
    for (group, name) in timeline.groups.iter().enumerate() {
        let (column, row) = (group % LEGEND_COLUMNS, group / LEGEND_COLUMNS);
        let (left, top) = legend_place(column, row, bottom);
        text(left + 16.0, top + 10.0, "", name);
    }
    for group in 0..timeline.groups.len() {
        let (left, top) = legend_place(group % LEGEND_COLUMNS, group / LEGEND_COLUMNS, bottom);
        let _ = writeln!(
            svg,
            "<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"12\" height=\"12\" fill=\"{}\"/>",
            color(timeline, group)
        );
    }
    for b in timeline.boxes.iter().filter(|b| b.row < timeline.rows.len() && b.end_s.is_finite()) {
        let (left, width) = (x(b.start_s), (x(b.end_s) - x(b.start_s)).max(NARROWEST));
        let top = tops[b.row] + b.lane as f64 * STRIP;
        let words = escaped(&b.label);
        let _ = writeln!(
            svg,
            "<rect x=\"{left:.2}\" y=\"{top:.1}\" width=\"{width:.2}\" height=\"{:.1}\" fill=\"{}\" stroke=\"white\" \
             stroke-width=\"0.5\"><title>{words}: {:.2} to {:.2} us</title></rect>",
            STRIP - 2.0,
            color(timeline, b.group),
            b.start_s * 1e6,
            b.end_s * 1e6
        );
        if b.label.chars().count() as f64 * CHARACTER < width - 2.0 {
            let middle = left + width / 2.0;
            let _ = writeln!(
                svg,
                "<text x=\"{middle:.1}\" y=\"{:.1}\" text-anchor=\"middle\" font-size=\"10\">{words}</text>",
                top + 12.0
            );
        }
    }
    svg.push_str("</svg>\n");
    svg
}

fn legend_place(column: usize, row: usize, bottom: f64) -> (f64, f64) {
    (LEFT + column as f64 * (WIDTH - LEFT) / LEGEND_COLUMNS as f64, bottom + 24.0 + row as f64 * STRIP)
}

/// Neighboring groups get distant hues (steps of the golden angle), light enough for black text.
fn color(timeline: &Timeline, group: usize) -> String {
    if timeline.faint == Some(group) {
        return "#ebebeb".to_string();
    }
    let hue = (group as f64 * 137.508) % 360.0;
    let light = if group.is_multiple_of(2) { 72 } else { 80 };
    format!("hsl({hue:.0},65%,{light}%)")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_lie_where_their_times_are_and_text_is_escaped() {
        let boxes = [(0.0, 1.0, "a<b"), (1.0, 4.0, "c"), (0.0, f64::INFINITY, "never")];
        let boxes = boxes.map(|(start_s, end_s, label)| TimelineBox {
            row: 0,
            lane: 0,
            start_s,
            end_s,
            label: label.into(),
            group: 0,
        });
        let timeline = Timeline {
            title: "t & t".into(),
            rows: vec!["rank 0".into()],
            groups: vec!["link".into()],
            boxes: boxes.to_vec(),
            ..Timeline::default()
        };
        let svg = timeline_svg(&timeline);
        assert!(svg.contains("t &amp; t") && svg.contains("a&lt;b") && !svg.contains("never"), "{svg}");
        // The whole width is 1090 for 4 s.
        assert!(svg.contains("x=\"362.50\"") && svg.contains("width=\"817.50\""), "{svg}");
        assert!(svg.contains("x=\"1180.0\" y=\"102.0\" text-anchor=\"end\">4000000.0 us<"), "{svg}");
    }
}
