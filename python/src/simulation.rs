//! A simulation that Python steps. Its session is bound to the thread that made it, so it lives in a thread of its own
//! and is sent orders.

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use loomtree::{Launch, Next, RunOptions, RunPlan, Session, SessionError, SessionPlace, State, StepDone, Watch};
use numpy::{PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::options::{SceneSource, options_of};
use crate::wait::{News, nap};
use crate::{bad_input, failed};

enum Order {
    /// To this step.
    Advance(u32),
    State,
}

enum Answer {
    Loaded(Result<Facts, Refusal>),
    Step(StepDone),
    /// The steps are done, or were stopped.
    Rest(Result<(), String>),
    State(Result<State, String>),
}

enum Refusal {
    BadInput(String),
    Failed(String),
}

/// What the scene is.
struct Facts {
    name: String,
    triangles: Vec<[u32; 3]>,
    origin_m: [f64; 3],
    pieces: Vec<(String, [u32; 2], [u32; 2])>,
    step_s: f64,
    steps_per_frame: u32,
    frames: u32,
}

type Array<T> = Py<PyArray2<T>>;

/// See the package's documentation.
#[pyclass(module = "loomtree._loomtree")]
pub(crate) struct Simulation {
    orders: Option<Sender<Order>>,
    answers: Mutex<Receiver<Answer>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    facts: Facts,
    triangles: Array<u32>,
    step: u32,
    /// Of `step`, once asked for.
    state: Option<KeptState>,
}

struct KeptState {
    positions: Array<f32>,
    velocities: Array<f32>,
    hash: String,
}

#[pymethods]
impl Simulation {
    /// `text`: the scene itself, if it is not the file `path`. `options`: JSON.
    #[new]
    fn new(py: Python<'_>, text: Option<String>, path: PathBuf, options: &str) -> PyResult<Simulation> {
        let options = options_of(options)?;
        let source = SceneSource::new(text, path);
        let (orders, to_do) = channel();
        let (tell, answers) = channel();
        let (stop, answers) = (Arc::new(AtomicBool::new(false)), Mutex::new(answers));
        let stops = stop.clone();
        let thread = std::thread::Builder::new().name("loomtree".into());
        let thread = thread.spawn(move || serve(&source, &options, &to_do, &tell, &stops)).map_err(failed)?;
        let facts = loop {
            match nap(py, &answers) {
                News::Message(Answer::Loaded(Ok(facts))) => break facts,
                News::Message(Answer::Loaded(Err(Refusal::BadInput(text)))) => return Err(bad_input(text)),
                News::Message(Answer::Loaded(Err(Refusal::Failed(text)))) => return Err(failed(text)),
                News::Message(_) | News::Nothing => py.check_signals()?,
                News::End => return Err(failed("the simulation has ended without a word")),
            }
        };
        let triangles = rows_of_indices(py, facts.triangles.clone())?;
        let (orders, thread) = (Some(orders), Some(thread));
        Ok(Simulation { orders, answers, stop, thread, facts, triangles, step: 0, state: None })
    }

    /// Makes `steps` steps; `progress` is called with the figures of each, and ends them by returning False.
    fn advance(&mut self, py: Python<'_>, steps: u32, progress: Option<Py<PyAny>>) -> PyResult<()> {
        let to = self.step.checked_add(steps).ok_or_else(|| bad_input("more steps than can be counted"))?;
        if steps == 0 {
            return Ok(());
        }
        self.stop.store(false, Ordering::Relaxed);
        self.send(Order::Advance(to))?;
        self.state = None;
        let mut error = None;
        loop {
            let tried = match nap(py, &self.answers) {
                News::Message(Answer::Step(done)) => {
                    self.step = done.step;
                    // Short steps leave no naps, and Ctrl-C must be heard all the same.
                    py.check_signals().and_then(|()| match &progress {
                        Some(progress) if error.is_none() => self.tell(py, &done, progress),
                        _ => Ok(true),
                    })
                }
                News::Message(Answer::Rest(rest)) => {
                    return match error {
                        Some(error) => Err(error),
                        None => rest.map_err(|text| {
                            self.orders = None;
                            failed(text)
                        }),
                    };
                }
                News::Message(_) | News::Nothing => py.check_signals().map(|()| true),
                News::End => return Err(self.ended()),
            };
            match tried {
                Ok(true) => {}
                Ok(false) => self.stop.store(true, Ordering::Relaxed),
                Err(raised) => {
                    self.stop.store(true, Ordering::Relaxed);
                    error.get_or_insert(raised);
                }
            }
        }
    }

    #[getter]
    fn step(&self) -> u32 {
        self.step
    }

    #[getter]
    fn time_s(&self) -> f64 {
        f64::from(self.step) * self.facts.step_s
    }

    #[getter]
    fn name(&self) -> &str {
        &self.facts.name
    }

    #[getter]
    fn step_s(&self) -> f64 {
        self.facts.step_s
    }

    #[getter]
    fn steps_per_frame(&self) -> u32 {
        self.facts.steps_per_frame
    }

    #[getter]
    fn frames(&self) -> u32 {
        self.facts.frames
    }

    #[getter]
    fn origin_m(&self) -> [f64; 3] {
        self.facts.origin_m
    }

    /// Name, first and end of the vertices, first and end of the triangles of every piece.
    #[getter]
    fn pieces(&self) -> Vec<(String, [u32; 2], [u32; 2])> {
        self.facts.pieces.clone()
    }

    #[getter]
    fn triangles(&self, py: Python<'_>) -> Array<u32> {
        self.triangles.clone_ref(py)
    }

    #[getter]
    fn positions(&mut self, py: Python<'_>) -> PyResult<Array<f32>> {
        Ok(self.state(py)?.positions.clone_ref(py))
    }

    #[getter]
    fn velocities(&mut self, py: Python<'_>) -> PyResult<Array<f32>> {
        Ok(self.state(py)?.velocities.clone_ref(py))
    }

    #[getter]
    fn state_hash(&mut self, py: Python<'_>) -> PyResult<String> {
        Ok(self.state(py)?.hash.clone())
    }

    /// Ends the workers. Arrays that were handed out stay.
    fn close(&mut self, py: Python<'_>) {
        self.stop.store(true, Ordering::Relaxed);
        self.orders = None;
        if let Some(thread) = self.thread.take() {
            py.detach(|| drop(thread.join()));
        }
    }
}

impl Simulation {
    fn send(&self, order: Order) -> PyResult<()> {
        let orders = self.orders.as_ref().ok_or_else(|| self.ended())?;
        orders.send(order).map_err(|_| self.ended())
    }

    fn ended(&self) -> PyErr {
        failed("the simulation is closed, or a step of it has failed")
    }

    /// Calls `progress`. False if it returned False.
    fn tell(&self, py: Python<'_>, done: &StepDone, progress: &Py<PyAny>) -> PyResult<bool> {
        let figures = PyDict::new(py);
        let first = &done.ranks[0];
        figures.set_item("step", done.step)?;
        figures.set_item("time_s", f64::from(done.step) * self.facts.step_s)?;
        figures.set_item("iterations", first.iterations)?;
        figures.set_item("converged", first.converged)?;
        figures.set_item("substeps", first.substeps)?;
        figures.set_item("contacts", done.ranks.iter().map(|rank| rank.contacts).sum::<u64>())?;
        figures
            .set_item("smallest_gap_m", done.ranks.iter().filter_map(|rank| rank.smallest_gap_m).reduce(f32::min))?;
        figures.set_item("wall_s", done.wall_s)?;
        let answer = progress.call1(py, (figures,))?;
        Ok(answer.is_none(py) || answer.is_truthy(py)?)
    }

    fn state(&mut self, py: Python<'_>) -> PyResult<&KeptState> {
        if self.state.is_none() {
            self.send(Order::State)?;
            let state = loop {
                match nap(py, &self.answers) {
                    News::Message(Answer::State(state)) => break state.map_err(failed)?,
                    News::Message(_) | News::Nothing => py.check_signals()?,
                    News::End => return Err(self.ended()),
                }
            };
            let hash = state.hash();
            let array = |values: Vec<_>| -> PyResult<Array<f32>> { rows_of_three(py, values) };
            self.state =
                Some(KeptState { positions: array(state.positions)?, velocities: array(state.velocities)?, hash });
        }
        self.state.as_ref().ok_or_else(|| failed("no state"))
    }
}

impl Drop for Simulation {
    /// The thread ends by itself once nobody gives it orders.
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// Vectors as an array of rows of three values, which takes over their memory.
pub(crate) fn rows_of_three(py: Python<'_>, values: Vec<loomtree::math::Vec3>) -> PyResult<Array<f32>> {
    let rows = values.len();
    let values: Vec<f32> = bytemuck::cast_vec(values);
    Ok(numpy::PyArray1::from_vec(py, values).reshape([rows, 3])?.unbind())
}

/// Triangles as an array of rows of three indices.
pub(crate) fn rows_of_indices(py: Python<'_>, triangles: Vec<[u32; 3]>) -> PyResult<Array<u32>> {
    let rows = triangles.len();
    Ok(numpy::PyArray1::from_vec(py, triangles.into_flattened()).reshape([rows, 3])?.unbind())
}

/// The thread of a session.
fn serve(
    source: &SceneSource,
    options: &RunOptions,
    orders: &Receiver<Order>,
    tell: &Sender<Answer>,
    stop: &AtomicBool,
) {
    let (plan, mut session) = match start(source, options) {
        Ok(started) => started,
        Err(refusal) => {
            let _ = tell.send(Answer::Loaded(Err(refusal)));
            return;
        }
    };
    let _ = tell.send(Answer::Loaded(Ok(facts_of(&plan))));
    let sentence = |error: &SessionError| error.sentence(&|vertex| plan.scene.vertex_name(vertex));
    for order in orders {
        let answer = match order {
            Order::State => Answer::State(session.state().map_err(|error| sentence(&error))),
            Order::Advance(to) => {
                let mut watch = Told { tell, stop };
                Answer::Rest(session.advance(to, &mut watch).map_err(|error| sentence(&error)))
            }
        };
        let has_failed = matches!(&answer, Answer::Rest(Err(_)) | Answer::State(Err(_)));
        if tell.send(answer).is_err() || has_failed {
            break;
        }
    }
    session.dismiss();
}

fn start(source: &SceneSource, options: &RunOptions) -> Result<(RunPlan, Session), Refusal> {
    let plan = source.plan(options).map_err(Refusal::BadInput)?;
    if plan.scene.sewing.is_some() {
        let what = "a scene that is sewn changes its mesh when it merges; loomtree.run makes it";
        return Err(Refusal::BadInput(what.into()));
    }
    let refusal = |error: SessionError| {
        let text = error.sentence(&|vertex| plan.scene.vertex_name(vertex));
        if error.is_bad_input() { Refusal::BadInput(text) } else { Refusal::Failed(text) }
    };
    let mut session = Session::assemble(SessionPlace::ALONE, &options.session(), &Launch::Threads).map_err(refusal)?;
    session.load(&plan).map_err(refusal)?;
    Ok((plan, session))
}

fn facts_of(plan: &RunPlan) -> Facts {
    let scene = &plan.scene;
    let ends = |range: &std::ops::Range<u32>| [range.start, range.end];
    Facts {
        name: scene.name.clone(),
        triangles: scene.mesh.triangles.clone(),
        origin_m: scene.origin_m.to_array(),
        pieces: scene
            .cloths
            .iter()
            .map(|cloth| (cloth.name.clone(), ends(&cloth.vertices), ends(&cloth.triangles)))
            .collect(),
        step_s: scene.settings.step_s,
        steps_per_frame: scene.settings.steps_per_frame,
        frames: scene.settings.frames,
    }
}

/// Tells of every step, and leaves when asked to.
struct Told<'a> {
    tell: &'a Sender<Answer>,
    stop: &'a AtomicBool,
}

impl Watch for Told<'_> {
    fn wants_events(&self, _step: u32) -> bool {
        false
    }

    fn step(&mut self, done: StepDone) -> Next {
        let is_gone = self.tell.send(Answer::Step(done)).is_err();
        if is_gone || self.stop.load(Ordering::Relaxed) { Next::Leave } else { Next::Step }
    }

    fn state(&mut self, _step: u32, _state: State) -> ControlFlow<()> {
        ControlFlow::Continue(())
    }
}
