//! Description of the machine for the report. Values that the system does not provide stay empty.

use serde::{Deserialize, Serialize};

use crate::transport::cores;

/// The machine section of a report.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Machine {
    /// Threads that this process may use.
    pub cores: usize,
    /// Model name of the processor.
    pub cpu: String,
    /// Main memory, bytes.
    pub memory_bytes: u64,
    /// Operating system and architecture.
    pub system: String,
}

impl Machine {
    /// Describes the current machine.
    pub fn here() -> Machine {
        let text = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
        let cpu_info = text("/proc/cpuinfo");
        let memory_info = text("/proc/meminfo");
        let cpu = field(&cpu_info, "model name").unwrap_or_default();
        let memory = field(&memory_info, "MemTotal");
        let kilobytes = memory.and_then(|m| m.split_whitespace().next()?.parse::<u64>().ok()).unwrap_or(0);
        Machine {
            cores: cores(),
            cpu: cpu.to_string(),
            memory_bytes: kilobytes * 1024,
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        }
    }
}

/// Value of the first line `key : value`.
fn field<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let line = text.lines().find(|line| line.starts_with(key))?;
    Some(line.split_once(':')?.1.trim())
}
