//! Signals that request a stop, and signals that must not end a process. The first request is recorded, and code that
//! can stop in an orderly way polls it; the second one ends the process at once. This module does not depend on runs.

use std::io;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::ExitStatus;
use std::sync::atomic::{AtomicBool, AtomicI32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use signal_hook::consts::{
    SIGABRT, SIGBUS, SIGFPE, SIGHUP, SIGILL, SIGINT, SIGKILL, SIGSEGV, SIGTERM, SIGXCPU, SIGXFSZ,
};
use signal_hook::iterator::Signals;

use super::console::note;

/// Whether a stop is what is waited for.
static WAITED_FOR: AtomicBool = AtomicBool::new(false);
/// Whether [`listen`] was called.
static LISTENING: AtomicBool = AtomicBool::new(false);
/// Number of the first signal that requested a stop; 0 = none yet.
static REQUESTED: AtomicI32 = AtomicI32::new(0);

/// A file that is removed when the second signal ends the process at once.
static LEFT_BEHIND: Mutex<Option<PathBuf>> = Mutex::new(None);

/// Sets, or with none forgets, the file that is removed when the second signal ends the process at once.
pub fn remove_at_once(path: Option<&Path>) {
    *LEFT_BEHIND.lock().unwrap_or_else(PoisonError::into_inner) = path.map(Path::to_path_buf);
}

/// A signal that requested a stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StopSignal(i32);

impl StopSignal {
    /// 128 + number of the signal, as shells report a process that a signal has ended.
    pub fn exit_code(self) -> u8 {
        (128 + self.0) as u8
    }

    /// For example `SIGTERM`.
    pub fn name(self) -> &'static str {
        signal_hook::low_level::signal_name(self.0).unwrap_or("a signal")
    }
}

impl std::fmt::Display for StopSignal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// The first signal that requested a stop, if one arrived since [`listen`].
pub fn stop_requested() -> Option<StopSignal> {
    let number = REQUESTED.load(Ordering::Relaxed);
    (number != 0).then_some(StopSignal(number))
}

/// Asks for a stop as SIGINT does, in a program that handles signals itself.
pub fn request_stop() {
    REQUESTED.store(SIGINT, Ordering::Relaxed);
}

/// Forgets that a stop was asked for, so that the next run of this process can begin.
pub fn forget_stop() {
    REQUESTED.store(0, Ordering::Relaxed);
}

/// End of a process, as the end of a sentence, with the usual meaning of a signal.
pub fn describe_end(status: ExitStatus) -> String {
    let Some(number) = status.signal() else {
        return match status.code() {
            Some(code) => format!("with exit code {code}"),
            None => "for an unknown reason".to_string(),
        };
    };
    let name = signal_hook::low_level::signal_name(number).map_or(format!("signal {number}"), str::to_string);
    let meaning = match number {
        SIGKILL => " (by hand, or by the system because memory ran out)",
        SIGBUS => " (shared memory is full: enlarge /dev/shm; or a file that it had mapped was cut)",
        SIGSEGV | SIGILL | SIGFPE | SIGABRT => " (a fault of this program or of a driver)",
        SIGTERM | SIGINT | SIGHUP => " (somebody asked it to end)",
        SIGXCPU => " (the limit on processor time, ulimit -t)",
        _ => "",
    };
    format!("killed by {name}{meaning}")
}

/// From now on the first SIGINT (Ctrl-C), SIGTERM or SIGHUP is recorded for [`stop_requested`], and the second one ends
/// the process with [`StopSignal::exit_code`]. An ignored SIGHUP stays ignored, because `nohup` sets it so.
///
/// # Errors
/// The system does not let the process handle signals.
pub fn listen() -> io::Result<()> {
    // A second listener would take the first signal for the second one.
    if LISTENING.swap(true, Ordering::Relaxed) {
        return Ok(());
    }
    let mut heard = vec![SIGINT, SIGTERM];
    if !is_ignored(SIGHUP) {
        heard.push(SIGHUP);
    }
    let mut signals = Signals::new(heard)?;
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        for number in signals.forever() {
            if REQUESTED.swap(number, Ordering::Relaxed) != 0 {
                if let Some(path) = &*LEFT_BEHIND.lock().unwrap_or_else(PoisonError::into_inner) {
                    let _ = std::fs::remove_file(path);
                }
                // Workers detect the end of the coordinator and clean up.
                std::process::exit(StopSignal(number).exit_code().into());
            }
            if !WAITED_FOR.load(Ordering::Relaxed) {
                note("stopping after the current step (Ctrl-C again: at once)");
            }
        }
    })?;
    Ok(())
}

/// From now on this process ignores SIGINT, SIGTERM and SIGHUP: another process stops it in order.
pub fn leave_stops_to_others() {
    for number in [SIGINT, SIGTERM, SIGHUP] {
        // If the system refuses this, the signal keeps its default action.
        let _ = signal_hook::flag::register(number, Arc::new(AtomicBool::new(false)));
    }
}

/// Returns at the next signal that asks to stop, after [`listen`]: for a program that has nothing left to do.
pub fn wait_for_stop() {
    WAITED_FOR.store(true, Ordering::Relaxed);
    while stop_requested().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
}

/// Makes a write beyond the limit of `ulimit -f` an error (EFBIG), which has a sentence, and not the end of the process
/// by SIGXFSZ.
pub fn survive_file_size_limit() {
    // If the system refuses this, the signal keeps its default action.
    let _ = signal_hook::flag::register(SIGXFSZ, Arc::new(AtomicBool::new(false)));
}

/// True if the process ignores signal `number`.
fn is_ignored(number: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    in_mask(&status, number)
}

/// Looks `number` up in the line `SigIgn:` of `/proc/PID/status`, a hexadecimal mask whose lowest bit is signal 1.
fn in_mask(status: &str, number: i32) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    mask.is_some_and(|mask| mask & (1 << (number - 1)) != 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exit_codes_are_those_of_shells() {
        let codes = [SIGHUP, SIGINT, SIGTERM].map(|number| StopSignal(number).exit_code());
        assert_eq!(codes, [129, 130, 143]);
        assert_eq!(StopSignal(SIGHUP).to_string(), "SIGHUP");
    }

    #[test]
    fn ends_are_named() {
        let end = |raw: i32| describe_end(ExitStatus::from_raw(raw));
        assert_eq!(
            end(SIGBUS),
            "killed by SIGBUS (shared memory is full: enlarge /dev/shm; or a file that it had mapped was cut)"
        );
        assert!(end(SIGKILL).starts_with("killed by SIGKILL (by hand, or by the system"));
        // With a core dump; a signal without a meaning of its own; an exit code.
        assert!(end(SIGSEGV | 0x80).starts_with("killed by SIGSEGV ("));
        assert_eq!(end(signal_hook::consts::SIGUSR1), "killed by SIGUSR1");
        assert_eq!(end(101 << 8), "with exit code 101");
    }

    #[test]
    fn ignored_signals_are_read_from_the_mask() {
        let status = "Name:\tx\nSigBlk:\t0000000000000004\nSigIgn:\t0000000000001001\nSigCgt:\t0000000000000002\n";
        assert!(in_mask(status, SIGHUP) && in_mask(status, 13));
        assert!(!in_mask(status, SIGINT) && !in_mask("", SIGHUP) && !in_mask("SigIgn:\tmany", SIGHUP));
    }
}
