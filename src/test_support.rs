//! What unit tests share with the test binaries: the same files, compiled into the library under test.
#![allow(unreachable_pub, reason = "the crate that these files belong to exports it")]

#[path = "../tests/support/src/device.rs"]
pub mod device;
#[path = "../tests/support/src/seeded.rs"]
pub mod seeded;
