//! A shot assigns the segments of its steps to sessions. Sessions run side by side, each on its own thread; a free
//! session gets the next segment. A plain run is one segment on one session.
//!
//! All segments send their news to one receiver. The news of a segment arrive in the order of its steps; the order
//! between segments is not defined.

use std::ops::{ControlFlow, Deref};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};

use super::crew::Launch;
use super::options::SessionOptions;
use super::plan::RunPlan;
use super::session::{Next, Session, SessionError, SessionPlace, StepDone, Watch, Way};
use crate::model::State;
use crate::os::signals;
use crate::protocol::WorkerReady;

/// Number of news that a session may send ahead of the receiver.
const AHEAD: usize = 1;

/// Consecutive steps on one session.
#[derive(Clone)]
pub struct Segment<'a> {
    /// The level to simulate.
    pub level: Level<'a>,
    /// Start state; none: the start state of the scene, which is that of step 0.
    pub start: Option<Arc<State>>,
    /// Step of the start state.
    pub first_step: u32,
    /// Last step.
    pub last_step: u32,
    /// Number of steps, from the first one, whose events are requested.
    pub trace_steps: u32,
    /// Whether the start state is told, too, if `wants_state` asks for its step.
    pub tells_start: bool,
    /// Whether the state after a step is requested.
    pub wants_state: Arc<dyn Fn(u32) -> bool + Send + Sync + 'a>,
    /// Whether the segment ends with the state after a step, which is one of those that are requested; none: it does
    /// not before its last step. An error is a sentence that ends the shot.
    pub ends_at: Option<Arc<EndsAt<'a>>>,
    /// How the steps get to their ends; none: as the forces have it.
    pub way: Option<Arc<dyn FindWay + 'a>>,
    /// What is done to the start state first.
    pub preparation: Option<Arc<dyn Prepare + 'a>>,
}

/// A level that somebody holds, or one that is made while the shot goes on.
#[derive(Clone)]
pub enum Level<'a> {
    /// Held by others.
    Of(&'a RunPlan),
    /// Held by its segments.
    Shared(Arc<RunPlan>),
}

impl Deref for Level<'_> {
    type Target = RunPlan;

    fn deref(&self) -> &RunPlan {
        match self {
            Level::Of(plan) => plan,
            Level::Shared(plan) => plan,
        }
    }
}

impl<'a> From<&'a RunPlan> for Level<'a> {
    fn from(plan: &'a RunPlan) -> Level<'a> {
        Level::Of(plan)
    }
}

impl From<Arc<RunPlan>> for Level<'_> {
    fn from(plan: Arc<RunPlan>) -> Self {
        Level::Shared(plan)
    }
}

/// As [`Segment::ends_at`].
pub type EndsAt<'a> = dyn Fn(u32, &State) -> Result<bool, String> + Send + Sync + 'a;

/// Prepares the start state of a segment: its last step before is made again and again.
pub trait Prepare: Send + Sync {
    /// The state to make that step from, and how it is led; none if the state that was reached is the one to start
    /// from. `reached`: the state after the step; at first the start state of the segment. `made`: the number of
    /// times that the step was made.
    ///
    /// # Errors
    /// A sentence that ends the shot.
    fn next(&self, reached: &State, made: u32) -> Result<Option<(State, Way)>, String>;
}

/// Leads the steps of a segment, as [`Watch::way`].
pub trait FindWay: Send + Sync {
    /// The way of `step`. `before`: the last state that was requested of this segment, or its start state.
    ///
    /// # Errors
    /// Why there is none.
    fn way(&self, step: u32, blocked: bool, before: Option<&State>) -> Result<Way, String>;
}

impl<'a> Segment<'a> {
    /// All steps of `level` to `last_step` as the forces have them, without states or events.
    pub fn plain(level: impl Into<Level<'a>>, last_step: u32) -> Segment<'a> {
        Segment {
            level: level.into(),
            start: None,
            first_step: 0,
            last_step,
            trace_steps: 0,
            tells_start: false,
            wants_state: Arc::new(|_| false),
            ends_at: None,
            way: None,
            preparation: None,
        }
    }
}

/// Where sessions get their segments from.
pub trait Source<'a>: Sync {
    /// The next segment for a session that is free, with its number; none if there will be no more. It may wait for
    /// segments that others have under way, but returns soon once `halt` is set.
    fn next(&self, session: usize, halt: &AtomicBool) -> Option<(usize, Segment<'a>)>;
}

/// Segments that are all known before.
struct List<'s, 'a>(Mutex<std::iter::Enumerate<std::slice::Iter<'s, Segment<'a>>>>);

impl<'a> Source<'a> for List<'_, 'a> {
    fn next(&self, _session: usize, _halt: &AtomicBool) -> Option<(usize, Segment<'a>)> {
        let (number, segment) = self.0.lock().ok()?.next()?;
        Some((number, segment.clone()))
    }
}

/// Event of a segment.
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
pub enum News {
    /// The session has loaded the level of the segment, now or for an earlier one.
    Ready(Vec<WorkerReady>),
    /// A step is done.
    Step(StepDone),
    /// The state after a step: a requested one, or the last one before a stop.
    State { step: u32, state: State },
    /// The segment has come to its last step.
    Ended,
}

/// An event with its session and segment.
pub struct Told {
    /// Number of the session.
    pub session: usize,
    /// Number of the segment.
    pub segment: usize,
    /// The news.
    pub news: News,
}

/// End of a shot without an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// All segments are done.
    Done,
    /// The user requested a stop.
    Stopped,
}

/// Error that ends a shot.
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
#[derive(Debug)]
pub enum ShotError<E> {
    /// A session failed in this segment.
    Session { segment: usize, error: SessionError },
    /// The receiver of the news returned an error.
    Listener(E),
}

/// Runs `segments` on `sessions` sessions at once (fewer if there are fewer segments). `tell` receives the news on the
/// thread of the caller; its error ends the shot.
///
/// # Errors
/// The first error. The other sessions leave after their current step.
pub fn play<E>(
    segments: &[Segment],
    sessions: usize,
    options: &SessionOptions,
    launch: &Launch,
    tell: &mut dyn FnMut(Told) -> Result<(), E>,
) -> Result<Ended, ShotError<E>> {
    let sessions = sessions.clamp(1, segments.len().max(1));
    play_from(&List(Mutex::new(segments.iter().enumerate())), sessions, options, launch, tell)
}

/// As [`play`], with the segments of `source`, which may depend on the news of others.
///
/// # Errors
/// The first error. The other sessions leave after their current step.
pub fn play_from<'a, E>(
    source: &dyn Source<'a>,
    sessions: usize,
    options: &SessionOptions,
    launch: &Launch,
    tell: &mut dyn FnMut(Told) -> Result<(), E>,
) -> Result<Ended, ShotError<E>> {
    let halt = AtomicBool::new(false);
    let (sender, receiver) = sync_channel(AHEAD);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..sessions)
            .map(|session| {
                let (place, sender) = (SessionPlace { session, sessions }, sender.clone());
                let halt = &halt;
                scope.spawn(move || {
                    let mut player = Player { place, session: None, level: None, halt, sender };
                    let played = player.play(source, options, launch);
                    // A stop is noticed by every session itself, which then sends its last state.
                    halt.fetch_or(played.is_err(), Ordering::Relaxed);
                    player.end();
                    played
                })
            })
            .collect();
        drop(sender);
        let told = listen(receiver, tell, &halt);
        let mut ended = Ended::Done;
        let mut failed = told.err().map(ShotError::Listener);
        for thread in threads {
            match thread.join() {
                Ok(Ok(Ended::Done)) => {}
                Ok(Ok(Ended::Stopped)) => ended = Ended::Stopped,
                Ok(Err((segment, error))) => failed = failed.or(Some(ShotError::Session { segment, error })),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        failed.map_or(Ok(ended), Err)
    })
}

/// Runs until all sessions have ended or `tell` returns an error. After an error the sessions cannot send any more and
/// leave.
fn listen<E>(
    receiver: Receiver<Told>,
    tell: &mut dyn FnMut(Told) -> Result<(), E>,
    halt: &AtomicBool,
) -> Result<(), E> {
    let told = receiver.into_iter().try_for_each(tell);
    halt.fetch_or(told.is_err(), Ordering::Relaxed);
    told
}

/// One session, which takes one segment after another.
struct Player<'h, 'a> {
    place: SessionPlace,
    session: Option<Session>,
    level: Option<(Level<'a>, Vec<WorkerReady>)>,
    halt: &'h AtomicBool,
    sender: SyncSender<Told>,
}

impl<'a> Player<'_, 'a> {
    fn play(
        &mut self,
        source: &dyn Source<'a>,
        options: &SessionOptions,
        launch: &Launch,
    ) -> Result<Ended, (usize, SessionError)> {
        while let Some((number, segment)) = source.next(self.place.session, self.halt) {
            let ended = self.segment(number, &segment, options, launch).map_err(|error| (number, error))?;
            if ended == Ended::Stopped || self.halt.load(Ordering::Relaxed) {
                return Ok(ended);
            }
        }
        Ok(Ended::Done)
    }

    fn segment(
        &mut self,
        number: usize,
        segment: &Segment<'a>,
        options: &SessionOptions,
        launch: &Launch,
    ) -> Result<Ended, SessionError> {
        let session = match &mut self.session {
            Some(session) => session,
            none => none.insert(Session::assemble(self.place, options, launch)?),
        };
        let whose = |news| Told { session: self.place.session, segment: number, news };
        let there = self.level.take().filter(|(level, _)| std::ptr::eq::<RunPlan>(&**level, &*segment.level));
        let is_loaded = there.is_some();
        let (level, ready) = match there {
            Some(there) => there,
            None => (segment.level.clone(), session.load(&segment.level)?),
        };
        self.level = Some((level, ready.clone()));
        if self.sender.send(whose(News::Ready(ready))).is_err() {
            return Ok(Ended::Done);
        }
        let mut start = segment.start.clone();
        if let (Some(state), Some(preparation)) = (&mut start, &segment.preparation) {
            let mut made = 0;
            while let Some((before, way)) = preparation.next(state, made).map_err(SessionError::Way)? {
                if self.halt.load(Ordering::Relaxed) || signals::stop_requested().is_some() {
                    return Ok(Ended::Stopped);
                }
                session.set_state(&before, segment.first_step - 1)?;
                let mut once = Once { way: Some(way), state: None };
                session.advance(segment.first_step, &mut once)?;
                let Some(reached) = once.state else { break };
                (*state, made) = (Arc::new(reached), made + 1);
            }
        }
        match &start {
            Some(state) => session.set_state(state, segment.first_step)?,
            None if is_loaded => session.set_state(&State::start_of(&segment.level.scene), 0)?,
            None => {}
        }
        if let Some(state) = start.as_deref().filter(|_| segment.tells_start)
            && (segment.wants_state)(segment.first_step)
        {
            let news = News::State { step: segment.first_step, state: state.clone() };
            if self.sender.send(whose(news)).is_err() {
                return Ok(Ended::Done);
            }
        }
        let mut watcher = Watcher {
            segment,
            halt: self.halt,
            sender: &self.sender,
            whose: &whose,
            last: start,
            stopped: false,
            fault: None,
        };
        session.advance(segment.last_step, &mut watcher)?;
        if let Some(fault) = watcher.fault {
            return Err(SessionError::Way(fault));
        }
        if watcher.stopped || self.halt.load(Ordering::Relaxed) {
            return Ok(if watcher.stopped { Ended::Stopped } else { Ended::Done });
        }
        // A receiver that has gone has set `halt`.
        let _ = self.sender.send(whose(News::Ended));
        Ok(Ended::Done)
    }

    /// Orders the workers to leave. After a failure hung workers are killed.
    fn end(self) {
        if let Some(session) = self.session {
            session.dismiss();
        }
    }
}

/// Makes one step and takes the state after it.
struct Once {
    way: Option<Way>,
    state: Option<State>,
}

impl Watch for Once {
    fn way(&mut self, _step: u32, _blocked: bool) -> Result<Way, String> {
        Ok(self.way.take().unwrap_or_default())
    }

    fn wants_events(&self, _step: u32) -> bool {
        false
    }

    fn step(&mut self, _done: StepDone) -> Next {
        Next::State
    }

    fn state(&mut self, _step: u32, state: State) -> ControlFlow<()> {
        self.state = Some(state);
        ControlFlow::Continue(())
    }
}

/// Forwards the events of a session, and stops it when required.
struct Watcher<'a> {
    segment: &'a Segment<'a>,
    halt: &'a AtomicBool,
    sender: &'a SyncSender<Told>,
    whose: &'a dyn Fn(News) -> Told,
    /// Of a segment whose steps are led.
    last: Option<Arc<State>>,
    stopped: bool,
    /// Why the end of the segment could not be decided.
    fault: Option<String>,
}

impl Watcher<'_> {
    fn tell(&self, news: News) -> ControlFlow<()> {
        match self.sender.send((self.whose)(news)) {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        }
    }
}

impl Watch for Watcher<'_> {
    fn way(&mut self, step: u32, blocked: bool) -> Result<Way, String> {
        let Some(find) = &self.segment.way else { return Ok(Way::Free) };
        find.way(step, blocked, self.last.as_deref())
    }

    fn wants_events(&self, step: u32) -> bool {
        step <= self.segment.first_step.saturating_add(self.segment.trace_steps)
    }

    fn step(&mut self, done: StepDone) -> Next {
        let step = done.step;
        if self.tell(News::Step(done)).is_break() || self.halt.load(Ordering::Relaxed) {
            return Next::Leave;
        }
        self.stopped = signals::stop_requested().is_some();
        if self.stopped || (self.segment.wants_state)(step) { Next::State } else { Next::Step }
    }

    fn state(&mut self, step: u32, state: State) -> ControlFlow<()> {
        if self.segment.way.is_some() {
            self.last = Some(Arc::new(state.clone()));
        }
        let ends = match &self.segment.ends_at {
            Some(ends_at) if !self.stopped => ends_at(step, &state),
            _ => Ok(false),
        };
        self.tell(News::State { step, state })?;
        match ends {
            Ok(false) if !self.stopped => ControlFlow::Continue(()),
            Ok(_) => ControlFlow::Break(()),
            Err(fault) => {
                self.fault = Some(fault);
                ControlFlow::Break(())
            }
        }
    }
}
