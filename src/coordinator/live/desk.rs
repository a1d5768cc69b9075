//! Where the clients of a live run and its session meet. Clients leave requests; between two steps the session takes
//! them one by one and answers. Nothing here waits for a client.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use serde_json::{Value, json};
use toml::Table;

use super::request::{Request, accepted, refused};
use crate::os::signals;

/// Between two looks at signals while the run stands still.
const LOOK: Duration = Duration::from_millis(30);
/// Requests that may wait at a time.
const WAITING_MOST: usize = 1024;

/// What the session does next.
pub(crate) enum Turn {
    /// Makes the next step.
    Go,
    /// Ends the run.
    Stop,
    /// Makes this change and answers.
    Change(Asked),
}

/// A change that somebody asks for.
pub(crate) struct Asked {
    /// Its fields.
    pub table: Table,
    answer: Sender<Value>,
}

impl Asked {
    /// Answers with the step after which the change acts, or a sentence. A client that has gone is no error.
    pub(crate) fn answer(&self, result: Result<u32, &str>) {
        let _ = self.answer.send(result.map_or_else(refused, accepted));
    }
}

enum Waiting {
    Control(Request, Sender<Value>),
    Change(Asked),
}

/// Requests that wait, and what clients may know of the run.
pub(crate) struct Desk {
    inner: Mutex<Inner>,
    changed: Condvar,
    /// Whether the session must look before the next step.
    is_asked: AtomicBool,
}

#[derive(Default)]
struct Inner {
    waiting: VecDeque<Waiting>,
    /// Steps done.
    step: u32,
    /// The step after which the run stands still; none while it goes on.
    until: Option<u32>,
    /// Who is answered when it stands still.
    steps_asked: Option<Sender<Value>>,
    stop: bool,
    has_ended: bool,
    /// What can be changed, as the answer to `status` has it.
    summary: Value,
}

impl Desk {
    /// For a run that has done `step` steps. If `paused`, it stands still until it is told to go on.
    pub(crate) fn new(step: u32, paused: bool) -> Desk {
        let inner = Inner { step, until: paused.then_some(step), ..Inner::default() };
        Desk { inner: Mutex::new(inner), changed: Condvar::new(), is_asked: AtomicBool::new(true) }
    }

    /// Nobody panics with the lock in a way that leaves half a request.
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes that `step` steps are done. Whether the session must call [`Desk::wait`] before the next one.
    pub(crate) fn is_due(&self, step: u32) -> bool {
        let mut inner = self.lock();
        inner.step = step;
        self.is_asked.load(Ordering::Relaxed) || inner.until.is_some_and(|until| step >= until)
    }

    /// What can be changed from now on.
    pub(crate) fn summarize(&self, summary: Value) {
        self.lock().summary = summary;
    }

    /// Takes the requests that wait, and returns with what the session has to do after `step`. While the run stands
    /// still this waits, until `halt` or a signal.
    pub(crate) fn wait(&self, step: u32, halt: &AtomicBool) -> Turn {
        let mut inner = self.lock();
        inner.step = step;
        loop {
            if inner.stop || halt.load(Ordering::Relaxed) || signals::stop_requested().is_some() {
                return Turn::Stop;
            }
            match inner.waiting.pop_front() {
                Some(Waiting::Change(asked)) => return Turn::Change(asked),
                Some(Waiting::Control(request, answer)) => {
                    if let Some(before) = inner.steps_asked.take() {
                        let _ = before.send(accepted(step));
                    }
                    match request {
                        Request::Steps(steps) => {
                            inner.until = Some(step.saturating_add(steps));
                            inner.steps_asked = Some(answer);
                            continue;
                        }
                        Request::Pause => inner.until = Some(step),
                        _ => inner.until = None,
                    }
                    let _ = answer.send(accepted(step));
                }
                None if inner.until.is_some_and(|until| step >= until) => {
                    if let Some(answer) = inner.steps_asked.take() {
                        let _ = answer.send(accepted(step));
                    }
                    inner = self.changed.wait_timeout(inner, LOOK).unwrap_or_else(PoisonError::into_inner).0;
                }
                None => {
                    self.is_asked.store(false, Ordering::Relaxed);
                    return Turn::Go;
                }
            }
        }
    }

    /// Steps that are done.
    pub(super) fn step(&self) -> u32 {
        self.lock().step
    }

    /// Whether a client has ended the run.
    pub(crate) fn is_stopped(&self) -> bool {
        self.lock().stop
    }

    /// The run has ended: whoever waits is told so.
    pub(crate) fn close(&self) {
        let mut inner = self.lock();
        inner.has_ended = true;
        let step = inner.step;
        if let Some(answer) = inner.steps_asked.take() {
            let _ = answer.send(accepted(step));
        }
        inner.waiting.clear();
    }

    /// The answer to a request of a client, which waits for it here.
    pub(super) fn answer(&self, request: Request) -> Value {
        match self.hand_in(request) {
            Ok(answer) => answer,
            Err(receiver) => receiver.recv().unwrap_or_else(|_| refused("the run has ended")),
        }
    }

    /// The answer, or where it will come.
    fn hand_in(&self, request: Request) -> Result<Value, Receiver<Value>> {
        let mut inner = self.lock();
        if inner.has_ended {
            return Ok(refused("the run has ended"));
        }
        match request {
            Request::Status => return Ok(inner.status()),
            Request::Stop => {
                inner.stop = true;
                self.is_asked.store(true, Ordering::Relaxed);
                self.changed.notify_all();
                return Ok(accepted(inner.step));
            }
            _ if inner.waiting.len() >= WAITING_MOST => return Ok(refused("too many requests wait")),
            _ => {}
        }
        let (answer, receiver) = channel();
        inner.waiting.push_back(match request {
            Request::Change(table) => Waiting::Change(Asked { table, answer }),
            other => Waiting::Control(other, answer),
        });
        self.is_asked.store(true, Ordering::Relaxed);
        self.changed.notify_all();
        Err(receiver)
    }
}

impl Inner {
    fn status(&self) -> Value {
        let mut status = accepted(self.step);
        let stands = self.until.is_some_and(|until| self.step >= until);
        let state = if self.summary.is_null() {
            "starting"
        } else if stands {
            "paused"
        } else {
            "running"
        };
        status["state"] = json!(state);
        if let (Value::Object(status), Value::Object(summary)) = (&mut status, &self.summary) {
            status.extend(summary.clone());
            let number = |name: &str| summary.get(name).and_then(Value::as_f64);
            if let (Some(steps), Some(step_s)) = (number("steps_per_frame"), number("step_s")) {
                status.insert("frame".into(), json!(self.step / steps.max(1.0) as u32));
                status.insert("time_s".into(), json!(f64::from(self.step) * step_s));
            }
        }
        status
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The session's side on a thread of its own: steps until it is stopped; changes are refused.
    fn run(desk: &Desk) -> u32 {
        let halt = AtomicBool::new(false);
        let mut step = 0;
        loop {
            if desk.is_due(step) {
                loop {
                    match desk.wait(step, &halt) {
                        Turn::Go => break,
                        Turn::Stop => {
                            desk.close();
                            return step;
                        }
                        Turn::Change(asked) => asked.answer(Err("no")),
                    }
                }
            }
            step += 1;
            std::thread::sleep(Duration::from_micros(50));
        }
    }

    #[test]
    fn a_run_stands_still_steps_and_goes_on() {
        let desk = Desk::new(0, true);
        std::thread::scope(|scope| {
            let session = scope.spawn(|| run(&desk));
            assert_eq!(desk.answer(Request::Steps(3)), accepted(3));
            assert_eq!(desk.answer(Request::Steps(2)), accepted(5));
            assert_eq!(desk.answer(Request::Status)["step"], 5);
            assert_eq!(desk.answer(Request::Change(Table::new())), refused("no"));
            assert_eq!(desk.answer(Request::Continue), accepted(5));
            let paused = desk.answer(Request::Pause)["step"].as_u64().unwrap();
            std::thread::sleep(Duration::from_millis(5));
            assert_eq!(desk.answer(Request::Status)["state"], "starting");
            desk.summarize(json!({}));
            let status = desk.answer(Request::Status);
            assert_eq!((&status["step"], &status["state"]), (&json!(paused), &json!("paused")));
            // Somebody who pauses while another one waits for steps answers both.
            let steps = scope.spawn(|| desk.answer(Request::Steps(1_000_000)));
            while desk.lock().steps_asked.is_none() {
                std::thread::yield_now();
            }
            assert_eq!(desk.answer(Request::Pause)["ok"], true);
            assert_eq!(steps.join().unwrap()["ok"], true);
            assert_eq!(desk.answer(Request::Stop)["ok"], true);
            session.join().unwrap();
        });
        assert_eq!(desk.answer(Request::Status), refused("the run has ended"));
    }
}
