//! The page of `loomtree view`: cloth, costs and seams of a run in a browser of this machine, while the run goes on
//! or afterwards.
//!
//! It reads run directories and nothing else, and writes nothing; requests to a run with `--live` go through its socket
//! (`steer`). `server` alone knows the HTTP library and decides
//! who is answered; `answers` makes an answer of a path, without sockets; the rest reads. The page itself (`page/`)
//! is plain HTML, CSS and JavaScript within this program.

mod answer;
mod answers;
mod contacts;
mod known;
mod lanes;
mod layer;
mod page;
mod server;
mod state;
mod steer;
mod watched;

pub use answer::Answer;
pub use answers::Answers;
pub use known::Known;
pub use server::{BindError, Server};
pub use watched::Watched;
