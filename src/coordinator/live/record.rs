//! The changes of a run in the order in which they act: those that its scene or a record brings, and those that clients
//! ask for. What does not stand in the scene stands in `run_changes.toml` before it acts.

use std::path::PathBuf;

use crate::output::write_atomically;
use crate::scene::{Change, Edit, changes_text};

const HEADING: &str = "# What was changed while this run went on: `step` is the number of steps that were done. \
                       `loomtree run --resume`\n# makes it again from a checkpoint, and `loomtree run SCENE --replay` \
                       with this file from the start.\n\n";

/// The changes of a run.
pub(crate) struct Record {
    path: PathBuf,
    /// Those that do not stand in the scene, in the order of their steps.
    own: Vec<Change>,
    /// Those that are still to be made, the next one last.
    ahead: Vec<Change>,
}

impl Record {
    /// The record `path` of a run that goes on after `step`, with what is known before.
    pub(crate) fn new(path: PathBuf, of_scene: &[Change], own: Vec<Change>, step: u32) -> Record {
        let mut ahead: Vec<Change> =
            merged(of_scene, &own).into_iter().filter(|one| one.step >= step && !one.edit.is_note()).collect();
        ahead.reverse();
        Record { path, own, ahead }
    }

    /// Whether a change acts after `step`.
    pub(crate) fn is_due(&self, step: u32) -> bool {
        self.ahead.last().is_some_and(|next| next.step <= step)
    }

    /// The next change that acts after `step`.
    pub(crate) fn take_due(&mut self, step: u32) -> Option<Change> {
        if self.is_due(step) { self.ahead.pop() } else { None }
    }

    /// Writes what is known before the run begins, so that it is there however the run ends.
    ///
    /// # Errors
    /// A sentence; the file is as it was.
    pub(crate) fn begin(&self) -> Result<(), String> {
        self.save()
    }

    /// Records a change before it acts.
    ///
    /// # Errors
    /// A sentence; the change must not act then.
    pub(crate) fn add(&mut self, change: Change) -> Result<(), String> {
        let welded = change.edit == Edit::Welded;
        // What is welded is welded before anything else is changed after that step.
        let before = |one: &Change| one.step < change.step || (!welded && one.step == change.step);
        let place = self.own.partition_point(before);
        // What is made again notes the same again.
        if change.edit.is_note() && self.own.contains(&change) {
            return Ok(());
        }
        self.own.insert(place, change);
        self.save().inspect_err(|_| drop(self.own.remove(place)))
    }

    fn save(&self) -> Result<(), String> {
        let text = changes_text(self.own.iter())?;
        write_atomically(&self.path, |out| {
            out.write_all(HEADING.as_bytes())?;
            out.write_all(text.as_bytes())
        })
        .map_err(|error| error.to_string())
    }
}

/// Changes in the order in which they act: of one step first what is welded, then those of the scene.
pub(crate) fn merged(of_scene: &[Change], own: &[Change]) -> Vec<Change> {
    let mut all: Vec<Change> = of_scene.iter().chain(own).cloned().collect();
    all.sort_by_key(|change| (change.step, change.edit != Edit::Welded));
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::read_changes;

    fn change(step: u32, pin: u32) -> Change {
        let text = format!("[[change]]\nstep = {step}\ndo = \"unpin\"\npin = {pin}");
        read_changes(&text, "x.toml".as_ref()).unwrap().remove(0)
    }

    #[test]
    fn changes_act_in_order_and_are_read_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run_changes.toml");
        let mut record = Record::new(path.clone(), &[change(9, 0)], vec![change(4, 1), change(20, 2)], 5);
        assert!(!record.is_due(8) && record.is_due(9));
        record.begin().unwrap();
        record.add(change(6, 3)).unwrap();
        record.add(Change::welded(9)).unwrap();
        record.add(Change::welded(9)).unwrap();
        record.add(change(9, 4)).unwrap();
        assert_eq!(record.take_due(9), Some(change(9, 0)));
        assert_eq!((record.take_due(9), record.take_due(20)), (None, Some(change(20, 2))));
        let own = read_changes(&std::fs::read_to_string(&path).unwrap(), &path).unwrap();
        assert_eq!(own, [change(4, 1), change(6, 3), Change::welded(9), change(9, 4), change(20, 2)]);
        let all = [change(4, 1), change(6, 3), Change::welded(9), change(9, 0), change(9, 4), change(20, 2)];
        assert_eq!(merged(&[change(9, 0)], &own), all);
        assert_eq!(Record::new(path, &[change(9, 0)], own, 0).ahead.len(), 5);
    }
}
