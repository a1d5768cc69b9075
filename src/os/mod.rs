//! Interface to the operating system: output streams, signals and limits. Linux only.

pub mod clock;
pub mod console;
pub mod limits;
pub mod panics;
pub mod signals;
