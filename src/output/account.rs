//! `loomtree report`: a run as one HTML file with pictures, curves, tables and a timeline. It needs no other file and
//! no script, so it can be sent to somebody.

use std::fmt::Write as _;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::plot::{PlotError, Series, line_chart_svg};
use super::report::{Report, Status, StepRecord};
use super::timeline::{Timeline, TimelineBox, timeline_svg};
use crate::telemetry::{Activity, Event, EventName};

/// Points of a curve at most; more are drawn over each other.
const POINTS: usize = 400;
/// Boxes of the timeline at most.
const BOXES: usize = 6000;
const MB: f64 = 1024.0 * 1024.0;

/// What goes into the file.
pub struct Account<'a> {
    /// The report of the run.
    pub report: &'a Report,
    /// Frames with their pictures as PNG files.
    pub pictures: &'a [(u32, Vec<u8>)],
    /// A traced step with the events of every rank.
    pub traced: Option<(u32, &'a [Vec<Event>])>,
    /// Bound of the collision tables of a worker, bytes.
    pub memory_limit_bytes: Option<u64>,
}

/// The text of the file.
///
/// # Errors
/// A curve cannot be drawn.
pub fn account(account: &Account) -> Result<String, PlotError> {
    let report = account.report;
    let header = &report.header;
    let workers = if header.workers == 1 { "worker" } else { "workers" };
    let title = format!("{}: {} triangles on {} {workers}", header.scene, header.triangles, header.workers);
    let mut html = format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>{}</title>\n\
         <style>{STYLE}</style>\n\
         </head>\n<body>\n<h1>{}</h1>\n",
        escaped(&title),
        escaped(&title)
    );
    html += &table("", &facts(report));
    pictures(&mut html, account.pictures);
    for chart in curves(report, account.memory_limit_bytes) {
        let svg = line_chart_svg(&chart.title, "frame", chart.unit, &chart.series)?;
        let _ = writeln!(html, "<figure class=\"chart\">{svg}</figure>");
    }
    if let Some((step, events)) = account.traced {
        let _ =
            writeln!(html, "<h2>What the workers did in step {step}</h2>\n<figure>{}</figure>", lanes(step, events));
    }
    html += &stages(report);
    html += &memory(report, account.memory_limit_bytes);
    html += &split(report);
    html += &events(report);
    html += "</body>\n</html>\n";
    Ok(html)
}

const STYLE: &str = "
body { font: 15px/1.5 system-ui, sans-serif; color: #1d232b; max-width: 1240px; margin: 2em auto; padding: 0 1.5em }
h1 { font-size: 1.5em }
h2 { font-size: 1.15em; margin: 2em 0 .6em }
figure { margin: 0 0 1em }
svg { max-width: 100%; height: auto }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(360px, 1fr)); gap: 12px }
.pictures img { width: 100%; border-radius: 6px }
figcaption { color: #667; font-size: .9em }
.chart { display: inline-block; width: 49%; min-width: 380px; vertical-align: top }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
td, th { padding: 3px 18px 3px 0; text-align: right; font-weight: 400 }
td:first-child { text-align: left }
tr + tr td { border-top: 1px solid #e6e8eb }
";

/// A row of a table.
type Row = Vec<String>;

fn table(title: &str, rows: &[Row]) -> String {
    let mut html = String::new();
    if !title.is_empty() {
        let _ = writeln!(html, "<h2>{}</h2>", escaped(title));
    }
    html += "<table>\n";
    for row in rows {
        let cells: String = row.iter().map(|cell| format!("<td>{}</td>", escaped(cell))).collect();
        let _ = writeln!(html, "<tr>{cells}</tr>");
    }
    html + "</table>\n"
}

fn facts(report: &Report) -> Vec<Row> {
    let header = &report.header;
    let status = match &header.status {
        Status::Running => "running".to_string(),
        Status::Done => "done".to_string(),
        Status::Stopped => "stopped".to_string(),
        Status::Failed(why) => format!("failed: {why}"),
    };
    let total_s: f64 = report.steps.iter().map(|step| step.stage_seconds.total).sum();
    let steps = report.steps.len().max(1) as f64;
    let frames = report.frames.len().saturating_sub(1);
    let mut rows: Vec<[String; 2]> = vec![
        ["status".into(), status],
        ["mesh".into(), format!("{} triangles, {} vertices", header.triangles, header.vertices)],
        ["workers".into(), format!("{}, executor {}", header.workers, header.executor)],
        ["devices".into(), header.devices.join(", ")],
        ["exchange, schedule".into(), format!("{}, {}, {}", header.exchange, header.schedule, header.topology)],
        ["preconditioner".into(), header.preconditioner.clone()],
        ["step".into(), format!("{:.3} ms, {} in a frame", 1e3 * header.step_s, header.steps_per_frame)],
        ["frames".into(), format!("{frames} of {}", header.frames_wanted)],
        [
            "steps".into(),
            format!("{}, {:.2} ms each, {total_s:.1} s in all", report.steps.len(), 1e3 * total_s / steps),
        ],
        ["machine".into(), {
            let machine = &header.machine;
            format!(
                "{}, {} cores, {:.0} GiB, {}",
                machine.cpu,
                machine.cores,
                machine.memory_bytes as f64 / MB / 1024.0,
                machine.system
            )
        }],
        ["loomtree".into(), header.version.clone()],
    ];
    for stage in &header.stages {
        let mut what = format!("{} triangles, {} vertices", stage.triangles, stage.vertices);
        if let Some(done) = &stage.straightened {
            let farthest_mm = 1e3 * done.farthest_m;
            what += &format!("; {} vertices straightened by up to {farthest_mm:.1} mm", done.vertices);
        }
        rows.push([format!("mesh after step {}", stage.step), what]);
    }
    if !header.open_seams.is_empty() {
        let clauses: Vec<String> = header.open_seams.iter().map(ToString::to_string).collect();
        rows.push(["open seams".into(), clauses.join("; ")]);
    }
    if let Some(last) = report.frames.last() {
        rows.push(["state of the last frame".into(), last.state_hash.clone()]);
    }
    rows.into_iter().map(|row| row.to_vec()).collect()
}

fn pictures(html: &mut String, pictures: &[(u32, Vec<u8>)]) {
    if pictures.is_empty() {
        return;
    }
    html.push_str("<h2>Frames</h2>\n<div class=\"pictures\">\n");
    for (frame, png) in pictures {
        let data = STANDARD.encode(png);
        let _ = writeln!(
            html,
            "<figure><img alt=\"frame {frame}\" src=\"data:image/png;base64,{data}\">\
             <figcaption>frame {frame}</figcaption></figure>"
        );
    }
    html.push_str("</div>\n<h2>Curves</h2>\n");
}

struct Curve {
    title: String,
    unit: &'static str,
    series: Vec<Series>,
}

/// Curves over the frames: the mean of a frame's steps, the smallest gap of them.
fn curves(report: &Report, limit: Option<u64>) -> Vec<Curve> {
    let mut frames: Vec<(u32, Vec<&StepRecord>)> = Vec::new();
    for step in &report.steps {
        match frames.last_mut() {
            Some((frame, steps)) if *frame == step.frame => steps.push(step),
            _ => frames.push((step.frame, vec![step])),
        }
    }
    let every = frames.len().div_ceil(POINTS).max(1);
    let series = |name: &str, value: &dyn Fn(&[&StepRecord]) -> Option<f64>| Series {
        name: name.to_string(),
        points: frames
            .iter()
            .step_by(every)
            .filter_map(|(frame, steps)| Some((f64::from(*frame), value(steps)?)))
            .collect(),
    };
    let mean = |of: fn(&StepRecord) -> f64| {
        move |steps: &[&StepRecord]| Some(steps.iter().map(|step| of(step)).sum::<f64>() / steps.len() as f64)
    };
    let ms = |name: &str, of: fn(&StepRecord) -> f64| series(name, &mean(of));
    let most = |bytes: fn(&StepRecord) -> &Vec<u64>| {
        move |steps: &[&StepRecord]| steps.iter().flat_map(|step| bytes(step)).max().map(|bytes| *bytes as f64 / MB)
    };
    let mut tables = vec![series("largest table of a worker", &most(|step| &step.proximity.bytes_per_rank))];
    if let Some(limit) = limit {
        tables.push(series("limit", &|_| Some(limit as f64 / MB)));
    }
    let curve = |title: &str, unit: &'static str, series: Vec<Series>| Curve { title: title.to_string(), unit, series };
    let all = vec![
        curve(
            "Iterations of a step",
            "iterations",
            vec![series("mean of the frame", &mean(|step| f64::from(step.iterations)))],
        ),
        curve(
            "Time of a step",
            "ms",
            vec![
                ms("all", |step| 1e3 * step.stage_seconds.total),
                ms("solve", |step| 1e3 * step.stage_seconds.solve),
                ms("collisions", |step| {
                    let stages = &step.stage_seconds;
                    1e3 * (stages.proximity + stages.contacts + stages.positions + stages.continuous + stages.zones)
                }),
                ms("assembly", |step| {
                    let stages = &step.stage_seconds;
                    1e3 * (stages.elements + stages.index_fill + stages.value_fill)
                }),
            ],
        ),
        curve("Contacts", "contacts", vec![series("mean of the frame", &mean(|step| step.contacts as f64))]),
        curve(
            "Smallest gap",
            "mm",
            vec![series("smallest of the frame", &|steps| {
                let gaps = steps.iter().filter_map(|step| step.smallest_gap_m);
                gaps.min_by(f64::total_cmp).map(|gap| 1e3 * gap)
            })],
        ),
        curve(
            "Bytes between ranks, of a step",
            "MB",
            vec![series("all ranks", &mean(|step| step.bytes_moved as f64 / MB))],
        ),
        curve(
            "Memory of a worker",
            "MB",
            vec![
                series("device, largest rank", &most(|step| &step.memory_bytes_per_rank)),
                series("resident, largest rank", &most(|step| &step.resident_bytes_per_rank)),
            ],
        ),
        curve("Collision tables", "MB", tables),
    ];
    let shows = |curve: &Curve| curve.series[0].points.iter().any(|(_, value)| value.is_finite() && *value > 0.0);
    all.into_iter().filter(shows).collect()
}

/// A band per rank: what it computed, received and waited for.
fn lanes(step: u32, ranks: &[Vec<Event>]) -> String {
    let shown = |event: &&Event| event.name != EventName::Step as u32;
    let begin_ns = ranks.iter().flatten().filter(shown).map(|event| event.start_ns).min().unwrap_or(0);
    let mut boxes: Vec<TimelineBox> = Vec::new();
    for (row, events) in ranks.iter().enumerate() {
        boxes.extend(events.iter().filter(shown).map(|event| TimelineBox {
            row,
            lane: 0,
            start_s: event.start_ns.saturating_sub(begin_ns) as f64 * 1e-9,
            end_s: event.end_ns.saturating_sub(begin_ns) as f64 * 1e-9,
            label: EventName::from_number(event.name).map_or("unknown", EventName::text).to_string(),
            group: match event.activity {
                a if a == Activity::Transfer as u32 => 1,
                a if a == Activity::Wait as u32 => 2,
                _ => 0,
            },
        }));
    }
    let all = boxes.len();
    if all > BOXES {
        boxes.sort_by(|a, b| (b.end_s - b.start_s).total_cmp(&(a.end_s - a.start_s)));
        boxes.truncate(BOXES);
    }
    let left_out = if all > BOXES { format!(", the {BOXES} longest of {all} slices") } else { String::new() };
    timeline_svg(&Timeline {
        title: format!("Step {step}"),
        subtitle: format!("measured{left_out}"),
        rows: (0..ranks.len()).map(|rank| format!("rank {rank}")).collect(),
        groups: ["computed", "transferred", "waited"].map(String::from).to_vec(),
        faint: Some(2),
        boxes,
    })
}

fn stages(report: &Report) -> String {
    let steps = report.steps.len();
    if steps == 0 {
        return String::new();
    }
    let total: f64 = report.steps.iter().map(|step| step.stage_seconds.total).sum();
    // The names are those of report.json.
    let mut sums: Vec<(String, f64)> = Vec::new();
    for step in &report.steps {
        let Ok(serde_json::Value::Object(stages)) = serde_json::to_value(step.stage_seconds) else { continue };
        for (name, seconds) in stages.iter().filter(|(name, _)| *name != "total") {
            let seconds = seconds.as_f64().unwrap_or(0.0);
            match sums.iter_mut().find(|(known, _)| known == name) {
                Some((_, sum)) => *sum += seconds,
                None => sums.push((name.clone(), seconds)),
            }
        }
    }
    sums.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut rows = vec![vec!["stage".to_string(), "ms a step".into(), "share".into()]];
    rows.extend(sums.iter().map(|(name, seconds)| {
        vec![
            name.replace('_', " "),
            format!("{:.3}", 1e3 * seconds / steps as f64),
            format!("{:.1} %", 100.0 * seconds / total),
        ]
    }));
    table("Stages (of each the slowest rank)", &rows)
}

fn memory(report: &Report, limit: Option<u64>) -> String {
    let most = |lists: fn(&StepRecord) -> &Vec<u64>, rank: usize| {
        let values = report.steps.iter().filter_map(|step| lists(step).get(rank).copied());
        format!("{:.1}", values.max().unwrap_or(0) as f64 / MB)
    };
    let ranks = report.steps.iter().map(|step| step.memory_bytes_per_rank.len()).max().unwrap_or(0);
    if ranks == 0 {
        return String::new();
    }
    let tables =
        limit.map_or("collision tables".into(), |limit| format!("collision tables of {:.0}", limit as f64 / MB));
    let mut rows = vec![vec!["largest, MB".to_string(), "device".into(), tables, "resident".into()]];
    rows.extend((0..ranks).map(|rank| {
        vec![
            format!("rank {rank}"),
            most(|step| &step.memory_bytes_per_rank, rank),
            most(|step| &step.proximity.bytes_per_rank, rank),
            most(|step| &step.resident_bytes_per_rank, rank),
        ]
    }));
    table("Memory", &rows)
}

fn split(report: &Report) -> String {
    let mut html = String::new();
    if !report.segments.is_empty() {
        let heads = ["segment", "steps", "session", "recovery", "hand-over", "busy, s", "idle, s", "K"];
        let mut rows = vec![heads.map(String::from).to_vec()];
        rows.extend(report.segments.iter().map(|s| {
            vec![
                s.segment.to_string(),
                format!("{} to {}", s.first_step, s.last_step),
                s.session.to_string(),
                s.recovery_steps.to_string(),
                s.handover_steps.to_string(),
                format!("{:.1}", s.busy_s),
                format!("{:.1}", s.idle_s),
                format!("{:.1}", s.k),
            ]
        }));
        html += &table("Segments", &rows);
    }
    if !report.seams.is_empty() {
        let heads = ["seam at step", "distance rms, mm", "largest, mm", "met", "jump, mm", "within segments, mm"];
        let mut rows = vec![heads.map(String::from).to_vec()];
        let mm = |meters: f64| format!("{:.3}", 1e3 * meters);
        rows.extend(report.seams.iter().map(|s| {
            let met = if s.met { "yes" } else { "no" };
            let [rms, most] = [s.distance_rms_m, s.distance_max_m].map(mm);
            vec![s.step.to_string(), rms, most, met.into(), mm(s.jump_max_m), mm(s.inner_median_max_m)]
        }));
        html += &table("Seams", &rows);
    }
    html
}

/// What a reader should know of: cloth that is let go or beyond its limits, solves that did not converge.
fn events(report: &Report) -> String {
    let mut rows = Vec::new();
    let count = |is: fn(&StepRecord) -> bool| report.steps.iter().filter(|step| is(step)).count();
    let mut add = |name: &str, value: String| rows.push(vec![name.to_string(), value]);
    add("steps whose solve stopped before its tolerance", count(|step| !step.converged).to_string());
    add("solves that broke off", report.steps.iter().map(|step| step.breakdowns).sum::<u32>().to_string());
    add("impact zones", report.steps.iter().map(|step| step.zones.zones).sum::<u64>().to_string());
    let beyond = report.frames.iter().filter_map(|frame| Some((frame.frame, frame.beyond_limits.as_ref()?)));
    if let Some((frame, worst)) = beyond.clone().max_by(|a, b| a.1.strain.total_cmp(&b.1.strain)) {
        let text = format!(
            "{} frames; the worst is frame {frame} with {:.1} % at {}",
            beyond.count(),
            100.0 * worst.strain,
            worst.place
        );
        add("triangles beyond their strain limits", text);
    }
    let let_go = report.frames.iter().filter(|frame| !frame.let_go.is_empty()).count();
    if let_go > 0 {
        add("frames with cloth let go between obstacles that overlap", let_go.to_string());
    }
    table("Events", &rows)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::{FrameRecord, ReportHeader, SeamRecord};

    #[test]
    fn one_file_says_it_all_and_needs_no_other() {
        let step = |number: u64| StepRecord {
            step: number,
            frame: number.div_ceil(2) as u32,
            iterations: 10 + number as u32,
            memory_bytes_per_rank: vec![3 << 20, 2 << 20],
            converged: true,
            ..StepRecord::default()
        };
        let report = Report {
            header: ReportHeader { scene: "a <b>".into(), workers: 2, triangles: 7, ..ReportHeader::default() },
            frames: vec![FrameRecord { state_hash: "cafe".into(), ..FrameRecord::default() }],
            steps: (1..=6).map(step).collect(),
            seams: vec![SeamRecord { step: 4, met: true, ..SeamRecord::default() }],
            ..Report::default()
        };
        let pictures = [(3, b"png".to_vec())];
        let made = Account { report: &report, pictures: &pictures, traced: None, memory_limit_bytes: None };
        let html = account(&made).unwrap();
        for part in [
            "a &lt;b&gt;: 7 triangles on 2 workers",
            "data:image/png;base64,cG5n",
            "<svg",
            "Iterations of a step",
            "rank 1",
            "3.0",
            "Seams",
            "cafe",
        ] {
            assert!(html.contains(part), "{part}");
        }
        for outside in ["<script", "src=\"http", "href=", "url("] {
            assert!(!html.contains(outside), "{outside}");
        }
    }
}
