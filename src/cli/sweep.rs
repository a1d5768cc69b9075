//! `loomtree run --set FIELD=[A, B, ..]`: one run for every value or combination of values, one after the other, a
//! table of them and a contact sheet with a row for each.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::run_lines::stopped;
use super::{CliError, answer};
use crate::gpu::Executor;
use crate::math::DVec3;
use crate::os::console::{complain, note};
use crate::os::signals;
use crate::output::picture::{PictureOptions, Subject, draw_rows};
use crate::output::{FrameSource, Report, RunDirectory, write_atomically};
use crate::transport::cores;

/// Pictures of a run on the sheet.
const PICTURES: usize = 5;
/// Size of a picture on the sheet, pixels.
const PICTURE: (u32, u32) = (320, 240);

/// One run of a sweep.
#[derive(Clone, Debug)]
pub(super) struct Planned {
    /// Its fields, as `--set` takes them.
    pub(super) set: Vec<String>,
    /// Its run directory.
    pub(super) out: PathBuf,
}

/// The runs of a sweep in the folder `base`: `run_001`, `run_002`, and so on.
///
/// # Errors
/// The folder holds a sweep, and `overwrite` is not set.
pub(super) fn planned(runs: Vec<Vec<String>>, base: &Path, overwrite: bool) -> Result<Vec<Planned>, CliError> {
    let of = |(i, set)| Planned { set, out: base.join(format!("run_{:03}", i + 1)) };
    let planned: Vec<Planned> = runs.into_iter().enumerate().map(of).collect();
    if !overwrite && let Some(there) = planned.iter().find(|run| RunDirectory::open(&run.out).is_ok()) {
        return Err(CliError::bad_input(format!(
            "{} already holds a run; replace the sweep with --overwrite, or choose another folder with --out",
            there.out.display()
        )));
    }
    Ok(planned)
}

/// What became of a run.
struct Outcome {
    /// Values of the fields that differ between runs, with their names.
    values: Vec<(String, String)>,
    out: PathBuf,
    error: Option<CliError>,
    steps: usize,
    seconds_per_step: f64,
}

/// Makes the runs with `make`, and writes `sweep.csv` and `sweep.png` into `base`.
///
/// # Errors
/// A run failed: all the others are made nevertheless, and the error names those that failed. A signal stops the sweep.
pub(super) fn make(
    planned: &[Planned],
    base: &Path,
    make: impl Fn(&Planned) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let differing = differing(planned);
    let mut outcomes = Vec::with_capacity(planned.len());
    for (i, run) in planned.iter().enumerate() {
        let values: Vec<(String, String)> = differing
            .iter()
            .filter_map(|&at| run.set[at].split_once('='))
            .map(|(name, value)| (name.trim().to_string(), value.trim().to_string()))
            .collect();
        let named: Vec<String> = values.iter().map(|(name, value)| format!("{name}={value}")).collect();
        note(format_args!("run {} of {}: {} in {}", i + 1, planned.len(), named.join(" "), run.out.display()));
        let error = make(run).err();
        if let Some(error) = error.as_ref().filter(|error| !error.message.is_empty()) {
            complain(format_args!("error: {error}"));
        }
        let report = Report::load(&run.out.join("report.json")).unwrap_or_default();
        let seconds: f64 = report.steps.iter().map(|step| step.stage_seconds.total).sum();
        let steps = report.steps.len();
        let seconds_per_step = if steps > 0 { seconds / steps as f64 } else { 0.0 };
        outcomes.push(Outcome { values, out: run.out.clone(), error, steps, seconds_per_step });
        if signals::stop_requested().is_some() {
            break;
        }
    }
    let csv = base.join("sweep.csv");
    std::fs::create_dir_all(base).map_err(CliError::failed)?;
    write_atomically(&csv, |out| out.write_all(table(&outcomes, ",").as_bytes())).map_err(CliError::failed)?;
    let sheet = match sheet(&outcomes, base) {
        Ok(sheet) => sheet,
        Err(what) => {
            note(format_args!("warning: no contact sheet: {what}"));
            None
        }
    };
    let mut text = table(&outcomes, "  ");
    text += &csv.display().to_string();
    if let Some(sheet) = &sheet {
        text += &format!("\n{}", sheet.display());
    }
    answer(&(text + "\n"), || {
        let runs: Vec<Value> = outcomes.iter().map(Outcome::json).collect();
        json!({ "runs": runs, "table": csv, "contact_sheet": sheet })
    })?;
    // Runs that were not begun are no failures, but the sweep is not whole.
    if outcomes.len() < planned.len() || signals::stop_requested().is_some() {
        return Err(stopped());
    }
    failures(&outcomes)
}

impl Outcome {
    fn status(&self) -> &'static str {
        match &self.error {
            None => "done",
            Some(error) if error.message.is_empty() => "stopped",
            Some(error) if error.exit_code == 2 => "refused",
            Some(_) => "failed",
        }
    }

    fn json(&self) -> Value {
        let set: serde_json::Map<String, Value> =
            self.values.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
        json!({
            "run": self.out,
            "set": set,
            "status": self.status(),
            "error": self.error.as_ref().map(|error| &error.message),
            "steps": self.steps,
            "seconds_per_step": self.seconds_per_step,
        })
    }

    fn name(&self) -> String {
        self.out.file_name().unwrap_or_default().to_string_lossy().into_owned()
    }
}

/// Places in the lists of fields whose values are not the same in all runs.
fn differing(planned: &[Planned]) -> Vec<usize> {
    let fields = planned.first().map_or(0, |run| run.set.len());
    (0..fields).filter(|&at| planned.iter().any(|run| run.set[at] != planned[0].set[at])).collect()
}

/// A line for every run, with a head. Columns are aligned unless they are separated by a comma.
fn table(outcomes: &[Outcome], separator: &str) -> String {
    let head: Vec<String> = std::iter::once("run".to_string())
        .chain(outcomes.first().into_iter().flat_map(|run| run.values.iter().map(|(name, _)| name.clone())))
        .chain(["status", "steps", "ms_per_step"].map(str::to_string))
        .collect();
    let mut rows = vec![head];
    for run in outcomes {
        let values = run.values.iter().map(|(_, value)| value.clone());
        let figures = [run.status().to_string(), run.steps.to_string(), format!("{:.2}", 1e3 * run.seconds_per_step)];
        rows.push(std::iter::once(run.name()).chain(values).chain(figures).collect());
    }
    let is_csv = separator == ",";
    let widths: Vec<usize> = (0..rows[0].len())
        .map(|column| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0))
        .collect();
    let cell = |(text, width): (&String, &usize)| match is_csv {
        true if text.contains([',', '"']) => format!("\"{}\"", text.replace('"', "\"\"")),
        true => text.clone(),
        false => format!("{text:<width$}"),
    };
    let line = |row: &Vec<String>| row.iter().zip(&widths).map(cell).collect::<Vec<_>>().join(separator);
    rows.iter().map(|row| line(row).trim_end().to_string() + "\n").collect()
}

/// One error for all runs that failed.
fn failures(outcomes: &[Outcome]) -> Result<(), CliError> {
    let failed: Vec<&Outcome> = outcomes.iter().filter(|run| run.error.is_some()).collect();
    if failed.is_empty() {
        return Ok(());
    }
    let name = |run: &&Outcome| {
        let values: Vec<String> = run.values.iter().map(|(name, value)| format!("{name}={value}")).collect();
        format!("{} ({})", run.name(), values.join(" "))
    };
    let names: Vec<String> = failed.iter().map(name).collect();
    let message = format!("{} of {} runs failed: {}", failed.len(), outcomes.len(), names.join(", "));
    let refused = failed.iter().all(|run| run.error.as_ref().is_some_and(|error| error.exit_code == 2));
    Err(CliError { exit_code: if refused { 2 } else { 1 }, message })
}

/// Draws the sheet; none where no run has frames.
fn sheet(outcomes: &[Outcome], base: &Path) -> Result<Option<PathBuf>, String> {
    let text = |error: &dyn std::fmt::Display| error.to_string();
    let mut drawn: Vec<(String, FrameSource)> = Vec::new();
    let (mut origin_m, mut up) = (None, None);
    for run in outcomes {
        let Ok(directory) = RunDirectory::open(&run.out) else { continue };
        let Ok(source) = FrameSource::open(&directory) else { continue };
        let header = Report::load(&directory.report()).unwrap_or_default().header;
        let origin_m = *origin_m.get_or_insert(DVec3::from_array(header.local_origin_m));
        up = up.or(header.up_axis.parse().ok());
        let mut name = run.name();
        for (field, value) in &run.values {
            name += &format!("\n{}={value}", field.rsplit('.').next().unwrap_or(field));
        }
        if run.error.is_some() {
            name += &format!("\n{}", run.status());
        }
        drawn.push((name, source.about(origin_m)));
    }
    if drawn.is_empty() {
        return Ok(None);
    }
    let (width, height) = PICTURE;
    let options = PictureOptions {
        width,
        height,
        up: up.unwrap_or_default(),
        origin_m: origin_m.unwrap_or(DVec3::ZERO),
        threads: cores(),
        ..PictureOptions::default()
    };
    let subjects: Vec<Subject> =
        drawn.iter().map(|(name, source)| Subject { name: name.clone(), ..Subject::new(source) }).collect();
    // The frames of the longest run, so that a run that broke off has a short row.
    let longest = drawn.iter().map(|(_, source)| source.numbers()).max_by_key(Vec::len).unwrap_or_default();
    let count = PICTURES.min(longest.len());
    let numbers: Vec<u32> =
        (0..count).map(|i| longest[if count > 1 { i * (longest.len() - 1) / (count - 1) } else { 0 }]).collect();
    let path = base.join("sweep.png");
    draw_rows(&subjects, &numbers, &options, &Executor::cpu(cores()), &path).map_err(|error| text(&error))?;
    Ok(Some(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(number: usize, value: &str, error: Option<CliError>) -> Outcome {
        let values = vec![("simulation.gravity_m_s2".to_string(), value.to_string())];
        let out = PathBuf::from(format!("out/run_{number:03}"));
        Outcome { values, out, error, steps: 20, seconds_per_step: 0.0125 }
    }

    #[test]
    fn tables_are_aligned_or_separated_by_commas() {
        let outcomes = [outcome(1, "[0, -1]", None), outcome(2, "3", Some(CliError::failed("x")))];
        let csv = "run,simulation.gravity_m_s2,status,steps,ms_per_step\nrun_001,\"[0, -1]\",done,20,12.50\n\
                   run_002,3,failed,20,12.50\n";
        assert_eq!(table(&outcomes, ","), csv);
        let text = table(&outcomes, "  ");
        let columns: Vec<usize> = text.lines().map(|line| line.find("20").or(line.find("steps")).unwrap()).collect();
        assert!(columns.windows(2).all(|pair| pair[0] == pair[1]), "{text}");
        assert_eq!(failures(&outcomes[..1]), Ok(()));
        let error = failures(&outcomes).unwrap_err();
        let sentence = "1 of 2 runs failed: run_002 (simulation.gravity_m_s2=3)";
        assert_eq!((error.exit_code, &error.message[..]), (1, sentence));
    }

    #[test]
    fn only_what_differs_is_shown() {
        let planned = |set: &[&str]| Planned { set: set.iter().map(|s| s.to_string()).collect(), out: PathBuf::new() };
        assert_eq!(differing(&[planned(&["a=1", "b=1", "c=1"]), planned(&["a=1", "b=2", "c=1"])]), [1]);
    }
}
