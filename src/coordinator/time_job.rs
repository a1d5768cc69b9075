//! The jobs of a split shot, and which of them may begin.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// A part of a split shot that one session makes at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Job {
    /// The coarse run.
    Coarse,
    /// A segment, with its recovery.
    Segment(usize),
    /// The hand-over from the segment before to this one.
    Seam(usize),
    /// A segment once more, from the end that the one before had after the sweep before.
    Again {
        /// From 1.
        sweep: usize,
        /// At least `sweep`: those before are exact by then.
        segment: usize,
    },
}

/// Sweeps have numbers from here on.
const SWEEP: usize = 1 << 20;

impl Job {
    pub(super) fn number(self) -> usize {
        match self {
            Job::Coarse => 0,
            Job::Segment(j) => 1 + 2 * j,
            Job::Seam(j) => 2 + 2 * j,
            Job::Again { sweep, segment } => sweep * SWEEP + segment,
        }
    }

    pub(super) fn of_number(number: usize) -> Job {
        match number {
            0 => Job::Coarse,
            again if again >= SWEEP => Job::Again { sweep: again / SWEEP, segment: again % SWEEP },
            odd if odd % 2 == 1 => Job::Segment(odd / 2),
            even => Job::Seam(even / 2 - 1),
        }
    }

    /// Its run directory under that of the run.
    pub(super) fn folder(self, run: &Path) -> PathBuf {
        match self {
            Job::Coarse => run.join("preview"),
            Job::Segment(j) => run.join(format!("segments/{j:03}")),
            Job::Seam(j) => run.join(format!("segments/{j:03}/seam")),
            Job::Again { sweep, segment } => run.join(format!("segments/{segment:03}/sweep_{sweep:03}")),
        }
    }

    pub(super) fn name(self) -> String {
        match self {
            Job::Coarse => "coarse run".into(),
            Job::Segment(j) => format!("segment {j}"),
            Job::Seam(j) => format!("seam {j}"),
            Job::Again { sweep, segment } => format!("sweep {sweep} of segment {segment}"),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    Waiting,
    UnderWay,
    Done,
}

/// The jobs that a start of the program is to make.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scope {
    /// All of them.
    #[default]
    All,
    /// The coarse run, and where it is cut.
    Coarse,
    /// One segment, whose start state is there.
    Segment(usize),
    /// What is left when all segments have been made one by one.
    Join,
}

impl Scope {
    fn holds(self, job: Job) -> bool {
        match self {
            Scope::All | Scope::Join => true,
            Scope::Coarse => job == Job::Coarse,
            Scope::Segment(j) => job == Job::Segment(j),
        }
    }

    /// Whether there is nothing left to begin or to wait for.
    pub(super) fn is_complete(self, table: &Table) -> bool {
        let own = table.stages.iter().filter(|(job, _)| self.holds(**job));
        !table.cuts.is_empty() && own.into_iter().all(|(_, stage)| *stage == Stage::Done)
    }
}

/// What is done and what may begin.
pub(super) struct Table {
    /// First steps of the segments, once they are known.
    pub cuts: Vec<u32>,
    pub stages: BTreeMap<Job, Stage>,
    /// The fine step up to which the coarse run has come.
    pub coarse_step: u32,
    /// Whether a hand-over has met its segment before the end of that; otherwise it has replaced the segment.
    pub met: BTreeMap<usize, bool>,
    /// Hand-overs under way whose segment before has been replaced since they began.
    outdated: BTreeSet<usize>,
    /// Number of sweeps.
    sweeps: usize,
    /// Sweeps of segments that were not made, because the segment would start as before.
    unchanged: BTreeSet<Job>,
}

impl Table {
    /// With the coarse run waiting and no cuts yet.
    pub(super) fn new(sweeps: usize) -> Table {
        Table {
            cuts: Vec::new(),
            stages: BTreeMap::from([(Job::Coarse, Stage::Waiting)]),
            coarse_step: 0,
            met: BTreeMap::new(),
            outdated: BTreeSet::new(),
            sweeps,
            unchanged: BTreeSet::new(),
        }
    }

    /// Takes the cuts: segments, seams and sweeps wait from now on, but for those that are known. `handed_over`:
    /// whether there are seams.
    pub(super) fn take_cuts(&mut self, cuts: Vec<u32>, handed_over: bool) {
        for j in 0..cuts.len() {
            self.stages.entry(Job::Segment(j)).or_insert(Stage::Waiting);
            if j > 0 && handed_over {
                self.stages.entry(Job::Seam(j)).or_insert(Stage::Waiting);
            }
            for sweep in 1..=self.sweeps.min(j) {
                self.stages.entry(Job::Again { sweep, segment: j }).or_insert(Stage::Waiting);
            }
        }
        self.cuts = cuts;
    }

    /// The hand-over to segment `j` has ended. All hand-overs are made at once, from the ends that the segments have.
    /// One that has replaced its segment, which is rare, changes that end, so that the next one is made again.
    pub(super) fn end_seam(&mut self, j: usize, has_met: bool) {
        if self.outdated.remove(&j) {
            self.stages.insert(Job::Seam(j), Stage::Waiting);
            return;
        }
        self.stages.insert(Job::Seam(j), Stage::Done);
        let had_replaced = self.met.insert(j, has_met) == Some(false);
        if has_met && !had_replaced {
            return;
        }
        match self.stages.get_mut(&Job::Seam(j + 1)) {
            Some(stage @ Stage::Done) => *stage = Stage::Waiting,
            Some(Stage::UnderWay) => {
                self.outdated.insert(j + 1);
            }
            _ => {}
        }
    }

    /// The job that made the last state of segment `j`: its hand-over if that has replaced it.
    pub(super) fn end_of(&self, j: usize) -> Job {
        if self.met.get(&j) == Some(&false) { Job::Seam(j) } else { Job::Segment(j) }
    }

    /// Whether the hand-overs to the segments 1 to `j` are done, so that none of them can change any more.
    pub(super) fn is_handed_over(&self, j: usize) -> bool {
        (1..=j).all(|j| self.is_done(Job::Seam(j)))
    }

    /// The job that made segment `j` as it is after a sweep; 0: before all of them.
    fn after(&self, j: usize, sweep: usize) -> Job {
        let sweeps = (1..=sweep.min(j)).rev().map(|sweep| Job::Again { sweep, segment: j });
        sweeps.into_iter().find(|job| !self.unchanged.contains(job)).unwrap_or(Job::Segment(j))
    }

    /// The job that made segment `j` as it is in the end, but for the hand-over.
    pub(super) fn last(&self, j: usize) -> Job {
        self.after(j, self.sweeps)
    }

    /// The jobs that a sweep of a segment goes by: the segment before and this one after the sweep before.
    pub(super) fn before_sweep(&self, sweep: usize, segment: usize) -> [Job; 2] {
        [self.after(segment - 1, sweep - 1), self.after(segment, sweep - 1)]
    }

    /// A sweep of a segment that would start as before need not be made.
    pub(super) fn leave(&mut self, job: Job) {
        self.stages.insert(job, Stage::Done);
        self.unchanged.insert(job);
    }

    /// Whether segment `j` and all its sweeps are done.
    pub(super) fn is_swept(&self, j: usize) -> bool {
        let sweeps = (1..=self.sweeps.min(j)).map(|sweep| Job::Again { sweep, segment: j });
        sweeps.chain([Job::Segment(j)]).all(|job| self.is_done(job))
    }

    pub(super) fn is_done(&self, job: Job) -> bool {
        self.stages.get(&job) == Some(&Stage::Done)
    }

    /// The first job whose inputs are there: segments before seams, so that long ones start early.
    pub(super) fn ready(&self, scope: Scope) -> Option<Job> {
        let waits = |job: &Job| scope.holds(*job) && self.stages.get(job) == Some(&Stage::Waiting);
        if waits(&Job::Coarse) {
            return Some(Job::Coarse);
        }
        let has_start = |&j: &usize| self.is_done(Job::Coarse) || self.coarse_step >= self.cuts[j];
        let segments = (0..self.cuts.len()).filter(has_start).map(Job::Segment);
        let seams = (1..self.cuts.len()).filter(|&j| {
            // One that is made again may replace its segment as before, or not any more.
            let stands = self.is_done(Job::Seam(j - 1)) || !self.met.contains_key(&(j - 1));
            self.is_done(Job::Segment(j - 1)) && self.is_done(Job::Segment(j)) && stands
        });
        let done_before = |j: usize, sweep: usize| match sweep.min(j) {
            0 => self.is_done(Job::Segment(j)),
            sweep => self.is_done(Job::Again { sweep, segment: j }),
        };
        let sweeps = self.stages.keys().copied().filter(|job| match *job {
            Job::Again { sweep, segment } => done_before(segment - 1, sweep - 1) && done_before(segment, sweep - 1),
            _ => false,
        });
        segments.chain(seams.map(Job::Seam)).chain(sweeps).find(waits)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(cuts: &[u32]) -> Table {
        let mut table = Table::new(0);
        table.take_cuts(cuts.to_vec(), true);
        table
    }

    /// Takes what is ready until nothing is.
    fn take(table: &mut Table) -> Vec<Job> {
        std::iter::from_fn(|| {
            let job = table.ready(Scope::All)?;
            table.stages.insert(job, Stage::UnderWay);
            Some(job)
        })
        .collect()
    }

    #[test]
    fn jobs_have_numbers() {
        for job in [
            Job::Coarse,
            Job::Segment(0),
            Job::Segment(1),
            Job::Seam(1),
            Job::Segment(7),
            Job::Seam(7),
            Job::Again { sweep: 3, segment: 4_000 },
        ] {
            assert_eq!(Job::of_number(job.number()), job);
        }
    }

    #[test]
    fn jobs_wait_for_what_they_start_from() {
        let mut table = table(&[0, 10, 20]);
        assert_eq!(take(&mut table), [Job::Coarse, Job::Segment(0)]);
        table.coarse_step = 12;
        assert_eq!(take(&mut table), [Job::Segment(1)]);
        table.stages.insert(Job::Coarse, Stage::Done);
        assert_eq!(take(&mut table), [Job::Segment(2)]);
        table.stages.insert(Job::Segment(0), Stage::Done);
        table.stages.insert(Job::Segment(2), Stage::Done);
        assert_eq!(take(&mut table), []);
        table.stages.insert(Job::Segment(1), Stage::Done);
        assert_eq!(take(&mut table), [Job::Seam(1), Job::Seam(2)]);
        table.end_seam(1, true);
        assert!(!Scope::All.is_complete(&table) && Scope::Coarse.is_complete(&table));
        table.end_seam(2, true);
        assert!(Scope::All.is_complete(&table));
    }

    #[test]
    fn a_hand_over_is_made_again_if_its_start_was_replaced() {
        let mut table = table(&[0, 10, 20, 30]);
        for job in [Job::Coarse, Job::Segment(0), Job::Segment(1), Job::Segment(2), Job::Segment(3)] {
            table.stages.insert(job, Stage::Done);
        }
        assert_eq!(take(&mut table), [Job::Seam(1), Job::Seam(2), Job::Seam(3)]);
        table.end_seam(3, true);
        // The third is under way from an end that is replaced now; the last one's start stands so far.
        table.end_seam(1, false);
        assert_eq!(take(&mut table), []);
        table.end_seam(2, true);
        assert!(table.is_handed_over(1) && !table.is_handed_over(2));
        assert_eq!(take(&mut table), [Job::Seam(2)]);
        // The segment is replaced, so the last hand-over, which was done, starts elsewhere.
        table.end_seam(2, false);
        assert_eq!(take(&mut table), [Job::Seam(3)]);
        table.end_seam(3, true);
        assert!(table.is_handed_over(3) && Scope::All.is_complete(&table));
    }

    #[test]
    fn sweeps_wait_for_the_sweep_before() {
        let again = |sweep, segment| Job::Again { sweep, segment };
        let mut table = Table::new(2);
        table.take_cuts(vec![0, 10, 20], false);
        for job in [Job::Coarse, Job::Segment(0), Job::Segment(1), Job::Segment(2)] {
            table.stages.insert(job, Stage::Done);
        }
        assert_eq!(take(&mut table), [again(1, 1), again(1, 2)]);
        assert_eq!(table.before_sweep(1, 2), [Job::Segment(1), Job::Segment(2)]);
        table.leave(again(1, 1));
        table.stages.insert(again(1, 2), Stage::Done);
        assert_eq!(take(&mut table), [again(2, 2)]);
        // The first sweep has not changed segment 1.
        assert_eq!(table.before_sweep(2, 2), [Job::Segment(1), again(1, 2)]);
        assert!(table.is_swept(1) && !table.is_swept(2));
        table.stages.insert(again(2, 2), Stage::Done);
        assert_eq!([0, 1, 2].map(|j| table.last(j)), [Job::Segment(0), Job::Segment(1), again(2, 2)]);
        assert!(Scope::All.is_complete(&table));
    }
}
