//! What unit tests share with the test binaries: the same files, compiled into the library under test.

#[path = "../tests/support/src/device.rs"]
pub(crate) mod device;
#[path = "../tests/support/src/seeded.rs"]
pub(crate) mod seeded;
