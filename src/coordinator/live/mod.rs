//! A run that is steered while it goes on (`loomtree run --live`): a socket in the run directory, requests that are
//! waited for between two steps, and the record of what was changed when.
//!
//! `server` has a thread per client and knows no run; `desk` is where clients and the session meet; `record` is the
//! file that a run is resumed and repeated with. A client that is slow or vanishes keeps its own thread waiting and
//! nothing else.

mod desk;
mod record;
mod request;
mod saved;
mod server;

pub(super) use desk::{Desk, Turn};
pub(super) use record::{Record, merged};
pub use server::{LiveError, LiveServer, connect};
