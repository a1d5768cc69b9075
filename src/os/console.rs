//! Output on stdout and stderr that survives the loss of its reader. The macros of the standard library panic when a
//! stream is closed or full, so a run would end because its progress is not read.

use std::fmt::Display;
use std::io::{self, ErrorKind, Write};
use std::sync::atomic::{AtomicBool, Ordering};

/// Whether [`note`] says nothing.
static QUIET: AtomicBool = AtomicBool::new(false);

/// Whether results are JSON.
static JSON: AtomicBool = AtomicBool::new(false);

/// From now on results are JSON.
pub fn be_json() {
    JSON.store(true, Ordering::Relaxed);
}

/// Whether [`be_json`] was called.
pub fn is_json() -> bool {
    JSON.load(Ordering::Relaxed)
}

/// From now on [`note`] says nothing; errors are still written.
pub fn be_quiet() {
    QUIET.store(true, Ordering::Relaxed);
}

/// Whether [`be_quiet`] was called.
pub fn is_quiet() -> bool {
    QUIET.load(Ordering::Relaxed)
}

/// Writes one line about a failure to stderr. A stream that is closed or full loses the line.
pub fn complain(line: impl Display) {
    // One write per line, so that lines of several processes do not mix.
    let _ = io::stderr().write_all(format!("{line}\n").as_bytes());
}

/// Writes one line of progress or advice to stderr. A stream that is closed or full loses the line.
pub fn note(line: impl Display) {
    if !is_quiet() {
        complain(line);
    }
}

/// Writes a result to stdout.
///
/// # Errors
/// The stream accepted only a part of it, for example because a disk is full. It is not an error if a reader closes its
/// end (`| head`).
pub fn print(text: &str) -> io::Result<()> {
    print_to(&mut io::stdout().lock(), text)
}

/// [`print()`] to any stream.
pub fn print_to(out: &mut dyn Write, text: &str) -> io::Result<()> {
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A stream that accepts no bytes.
    struct Refusing(ErrorKind);

    impl Write for Refusing {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(self.0.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn only_a_reader_that_left_is_forgiven() {
        let mut taken = Vec::new();
        print_to(&mut taken, "text\n").unwrap();
        assert_eq!(taken, b"text\n");
        print_to(&mut Refusing(ErrorKind::BrokenPipe), "text").unwrap();
        assert_eq!(print_to(&mut Refusing(ErrorKind::StorageFull), "text").unwrap_err().kind(), ErrorKind::StorageFull);
    }
}
