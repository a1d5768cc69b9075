//! What a program has from the system it runs on: its output streams, its signals and its limits. Linux only.

pub mod clock;
pub mod console;
pub mod limits;
pub mod signals;
