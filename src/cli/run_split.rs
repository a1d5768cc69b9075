//! `loomtree run --segments P`: a shot that is split in time.

use super::CliError;
use super::run_lines::{Made, conclude, introduce};
use super::start_state::Places;
use crate::coordinator::plan::scene_text;
use crate::coordinator::{Launch, PlanError, RunOptions, RunPlaces, Scope, TimeError, TimePlan, run_split};
use crate::os::console::note;
use crate::os::signals;
use crate::output::Existing;
use crate::time_parallel::partition;

/// Runs the command. `recorded`: the scene's text, if the run goes on with it.
pub(super) fn run(
    recorded: Option<&str>,
    options: &RunOptions,
    places: &RunPlaces,
    scope: Scope,
    launch: &Launch,
) -> Result<Made, CliError> {
    let text = match recorded {
        Some(text) => text.to_string(),
        None => scene_text(&places.scene, &options.set).map_err(CliError::bad_input)?,
    };
    let plan = TimePlan::new(&text, &places.scene, options).map_err(|error| match error {
        TimeError::Plan(error) => match error.blaming_set(&places.scene, options) {
            PlanError::Scene(mut error) => CliError::bad_input(Places::beside(&places.out).refuse(&mut error)),
            other => CliError::bad_input(other),
        },
        other => CliError::bad_input(other),
    })?;
    introduce(&plan.fine, options);
    let coarse = &plan.coarse.scene;
    note(format_args!(
        "{} segments from a coarse run of {} triangles in steps of {:.4} s",
        options.time.segments,
        coarse.mesh.triangles.len(),
        coarse.settings.step_s
    ));
    if places.existing != Existing::Resume {
        note(bound(&plan));
    }
    signals::listen().map_err(|error| CliError::failed(format!("cannot listen for signals: {error}")))?;
    let made = run_split(&plan, options, places, scope, launch);
    if scope == Scope::Coarse && made.as_ref().is_ok_and(|summary| !summary.stopped) {
        let out = places.out.display();
        note(format_args!(
            "next, in any order and on any machines that see {out}: `loomtree run --out {out} --only-segment J` for \
             each segment, then `loomtree join {out}`"
        ));
    }
    conclude(made, places)
}

/// What Eq. 16 allows for, with the ratio of costs that is expected before anything is measured.
fn bound(plan: &TimePlan) -> String {
    let (steps, ratio) = (u64::from(plan.steps()), plan.expected_ratio());
    let handover = if plan.options.hands_over() { u64::from(plan.handover_most()) } else { 0 };
    let extra = u64::from(plan.recovery_most()) + handover;
    let of = |segments: u32| {
        let balanced = partition::speedup_balanced(ratio, segments as usize);
        partition::speedup_with_extra_steps(steps, extra, balanced)
    };
    let segments = plan.options.segments;
    let mut line = format!(
        "{segments} processes side by side could be {:.1} times as fast as one [Liang and Lin 2018, Eq. 16: \
         N = {steps}, K = {ratio:.0} expected, R + B at most {extra}]",
        of(segments)
    );
    // The largest number from which on doubling gains less than a tenth.
    let enough = (0..12).map(|n| 1 << n).find(|&p| of(2 * p) < 1.1 * of(p)).unwrap_or(4096);
    if segments > enough {
        line += &format!("; more than {enough} segments hardly help a shot of this length");
    }
    line
}
