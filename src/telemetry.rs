//! Events of a rank: what it computed, transferred and waited for, when, and how many bytes and flops that took.
//! `output::trace` writes them; the interconnect laboratory re-times them. Recording never changes what is computed.

use std::time::Instant;

use bytemuck::{Pod, Zeroable};

/// Kind of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Activity {
    /// A kernel or host computation.
    Compute = 0,
    /// Reading (or publishing) a sub-vector or halo of a transfer stage.
    Transfer = 1,
    /// Blocked on another rank.
    Wait = 2,
}

/// Names of events. Messages carry the number; the trace shows the text.
macro_rules! event_names {
    ($($variant:ident = $text:literal),* $(,)?) => {
        /// Subject of an event.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[repr(u32)]
        pub enum EventName { $(#[doc = concat!("Shown as `", $text, "`.")] $variant),* }
        impl EventName {
            const ALL: &'static [EventName] = &[$(EventName::$variant),*];
            /// Text shown in the trace.
            pub fn text(self) -> &'static str { match self { $(EventName::$variant => $text),* } }
            /// The event with this number, if there is one.
            pub fn from_number(n: u32) -> Option<EventName> { Self::ALL.get(n as usize).copied() }
            /// The event that is shown with this text, if there is one.
            pub fn from_text(text: &str) -> Option<EventName> {
                Self::ALL.iter().copied().find(|name| name.text() == text)
            }
        }
    };
}
event_names! {
    Step = "step",
    ExchangeState = "exchange state",
    ReadState = "read state",
    Elements = "element records",
    IndexFill = "index fill",
    ValueFill = "value fill",
    Precondition = "preconditioner",
    Publish = "publish sub-vector",
    Receive = "receive sub-vector",
    SpmvLocal = "SpMV local rows",
    SpmvRemote = "SpMV rows with halo",
    SpmvBlock = "SpMV block A_ij",
    VectorUpdate = "vector update",
    AllReduce = "all-reduce",
    Advance = "advance state",
    ProximityQuery = "proximity query",
    ContinuousQuery = "continuous collision query",
    ImpactZones = "impact zones",
    Residual = "residual in f64",
    LocalContacts = "contacts of own rows",
    SharePositions = "share positions",
    ShareQuery = "share boxes and loads",
    ShareContacts = "share contacts",
    ShareImpacts = "share impacts",
    ShareMoved = "share moved vertices",
}

impl EventName {
    /// True for exchanges of all ranks with all ranks outside of the solver. Such an exchange is a transfer from the
    /// own rank (handing over, also if it has nothing to tell), then per other rank that tells something a wait for it
    /// and a transfer from it; an all-gather is a wait for the own rank, whose bytes are the own values.
    pub fn is_share(self) -> bool {
        use EventName::*;
        matches!(self, SharePositions | ShareQuery | ShareContacts | ShareImpacts | ShareMoved)
    }
}

/// One event; plain data, so that it can cross processes as bytes.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Event {
    /// An [`EventName`] as number.
    pub name: u32,
    /// An [`Activity`] as number.
    pub activity: u32,
    /// Step in which it happened.
    pub step: u32,
    /// Transfer stage counting from 1, or 0.
    pub stage: u32,
    /// Rank that the bytes came from, or the own rank.
    pub source: u32,
    /// Sub-vector index, or the own rank.
    pub vector: u32,
    /// Time at which the host asked for it, nanoseconds since the recorder's epoch. It orders the events of a rank; a
    /// device may begin later.
    pub asked_ns: u64,
    /// Nanoseconds since the recorder's epoch.
    pub start_ns: u64,
    /// Nanoseconds since the recorder's epoch.
    pub end_ns: u64,
    /// Bytes read and written by a kernel, or moved by a transfer.
    pub bytes: u64,
    /// Floating point operations of a kernel.
    pub flops: u64,
}

/// The clock of a device that runs kernels while the host goes on.
pub trait DeviceClock {
    /// Puts a mark behind the device's commands so far. `None`: the device has no such clock, but everything asked so
    /// far has been done.
    fn mark(&self) -> Option<u32>;
    /// Times at which the device reached each mark, by number, on the axis of `host_ns`. Forgets all marks.
    fn read(&self, host_ns: &dyn Fn() -> u64) -> Vec<u64>;
}

/// A point in a rank's time, for [`Recorder::end`].
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    ns: u64,
    /// Set if what follows are kernels.
    kernels: bool,
    mark: Option<u32>,
}

/// Marks of an event that a device ran.
struct Marked {
    event: usize,
    start: u32,
    end: u32,
}

/// Collects the events of one rank. Disabled recorders cost one branch per event.
pub struct Recorder {
    epoch: Instant,
    /// Nanoseconds between the Unix epoch and `epoch`: lets tracks of several processes share one time axis.
    pub epoch_unix_ns: u64,
    enabled: bool,
    step: u32,
    events: Vec<Event>,
    clock: Option<Box<dyn DeviceClock>>,
    marked: Vec<Marked>,
}

impl Recorder {
    /// A recorder that starts disabled. `clock`: that of the device that runs the kernels; none for native code.
    pub fn new(clock: Option<Box<dyn DeviceClock>>) -> Recorder {
        let unix = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
        Recorder {
            epoch: Instant::now(),
            epoch_unix_ns: unix.as_nanos() as u64,
            enabled: false,
            step: 0,
            events: Vec::new(),
            clock,
            marked: Vec::new(),
        }
    }

    /// Begins a step; its events are kept if `enabled`.
    pub fn begin_step(&mut self, step: u32, enabled: bool) {
        self.step = step;
        self.enabled = enabled;
    }

    fn host_ns(&self) -> u64 {
        self.epoch.elapsed().as_nanos() as u64
    }

    /// The start of something that the host does, or waits for.
    pub fn now(&self) -> Moment {
        Moment { ns: self.host_ns(), kernels: false, mark: None }
    }

    /// The start of kernels that are about to be asked for; the event lasts as long as they do.
    pub fn before_kernels(&self) -> Moment {
        let mark = self.clock.as_ref().filter(|_| self.enabled).and_then(|clock| clock.mark());
        Moment { ns: self.host_ns(), kernels: true, mark }
    }

    /// Records an event of the own rank that began at `start` and ends now.
    pub fn end(&mut self, name: EventName, activity: Activity, start: Moment, bytes: u64, flops: u64) {
        self.end_transfer(name, activity, start, (0, 0, 0), bytes, flops);
    }

    /// As [`Recorder::end`], with (stage, source, vector) of a transfer.
    pub fn end_transfer(
        &mut self,
        name: EventName,
        activity: Activity,
        start: Moment,
        route: (u32, u32, u32),
        bytes: u64,
        flops: u64,
    ) {
        if self.enabled {
            let (stage, source, vector) = route;
            if let Some(clock) = self.clock.as_ref().filter(|_| start.kernels)
                && let (Some(start), Some(end)) = (start.mark, clock.mark())
            {
                self.marked.push(Marked { event: self.events.len(), start, end });
            }
            let end_ns = self.host_ns();
            self.events.push(Event {
                name: name as u32,
                activity: activity as u32,
                step: self.step,
                stage,
                source,
                vector,
                asked_ns: start.ns,
                start_ns: start.ns,
                end_ns,
                bytes,
                flops,
            });
        }
    }

    /// Hands the recorded events over and forgets them. Waits for the device if it ran some.
    pub fn take(&mut self) -> Vec<Event> {
        let mut events = std::mem::take(&mut self.events);
        if let Some(clock) = self.clock.as_ref().filter(|_| !self.marked.is_empty()) {
            let times = clock.read(&|| self.host_ns());
            for Marked { event, start, end } in self.marked.drain(..) {
                let (Some(&start), Some(&end)) = (times.get(start as usize), times.get(end as usize)) else { continue };
                // The two clocks meet within the time of a wait; nothing ran before it was asked for.
                let asked_ns = events[event].asked_ns;
                (events[event].start_ns, events[event].end_ns) = (start.max(asked_ns), end.max(asked_ns));
            }
        }
        events
    }
}
