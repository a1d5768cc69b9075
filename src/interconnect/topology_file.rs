//! Topology files (TOML; `docs/topology.md` describes them for users) -> [`Topology`]. Fails with one sentence that
//! names the file, the line and the link or field.

use std::io::Read;
use std::path::Path;

use serde::Deserialize;
use toml::Spanned;

use super::parts::{DeviceModel, Duplex, Fault, Link, Parts, Place};
use super::topology::Topology;
use super::topology_error::TopologyError;
use super::validate::check_name;

/// Largest topology file that is read; the largest useful one is a few hundred lines.
const MAX_FILE_BYTES: u64 = 1 << 20;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawTopology {
    name: String,
    device: Spanned<DeviceModel>,
    #[serde(default)]
    gpus_forward: bool,
    #[serde(default)]
    switches: Vec<Spanned<String>>,
    gpus: Vec<Spanned<RawGpu>>,
    #[serde(default)]
    links: Vec<Spanned<RawLink>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawGpu {
    id: usize,
    name: String,
    host: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawLink {
    between: [String; 2],
    bandwidth_gb_s: f64,
    latency_us: f64,
    duplex: Duplex,
}

impl Topology {
    /// Reads a topology file.
    pub fn read(path: &Path) -> Result<Topology, TopologyError> {
        let file = path.display().to_string();
        let mut bytes = Vec::new();
        let read = std::fs::File::open(path).and_then(|f| f.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes));
        match read {
            Err(source) => Err(TopologyError::Read { file, source }),
            Ok(_) => Topology::parse(&bytes, &file),
        }
    }

    /// Reads the bytes of a topology file; `file` is the name shown in errors.
    pub fn parse(bytes: &[u8], file: &str) -> Result<Topology, TopologyError> {
        let malformed = |line: Option<usize>, message: String| TopologyError::Malformed {
            file: file.to_owned(),
            line,
            message: one_line(&message),
        };
        if bytes.len() as u64 > MAX_FILE_BYTES {
            return Err(malformed(None, format!("a topology file has at most {MAX_FILE_BYTES} bytes")));
        }
        let text = std::str::from_utf8(bytes).map_err(|error| {
            malformed(Some(line_of(bytes, error.valid_up_to())), "a topology file must be UTF-8 text".into())
        })?;
        let raw: RawTopology = toml::from_str(text).map_err(|error| {
            malformed(error.span().map(|span| line_of(bytes, span.start)), error.message().to_owned())
        })?;
        // Spans outlive the values: the check speaks of the i-th link, the user is shown its line.
        let starts = Starts {
            device: raw.device.span().start,
            gpus: raw.gpus.iter().map(|gpu| gpu.span().start).collect(),
            switches: raw.switches.iter().map(|switch| switch.span().start).collect(),
            links: raw.links.iter().map(|link| link.span().start).collect(),
        };
        let hosts = hosts_of(&raw);
        let built = hosts.and_then(|hosts| Topology::build(parts_of(raw)).map(|built| built.with_hosts(hosts)));
        built.map_err(|Fault { place, message }| {
            malformed(starts.of(place).map(|offset| line_of(bytes, offset)), message)
        })
    }
}

/// By id of the GPU: number of its host, in the order in which the file names them. GPUs without hosts share one.
fn hosts_of(raw: &RawTopology) -> Result<Vec<usize>, Fault> {
    let gpus: Vec<&RawGpu> = raw.gpus.iter().map(Spanned::get_ref).collect();
    let mut names: Vec<&str> = Vec::new();
    let mut hosts = vec![0; gpus.len()];
    for (i, gpu) in gpus.iter().enumerate() {
        let Some(host) = &gpu.host else { continue };
        if let Some(without) = gpus.iter().position(|gpu| gpu.host.is_none()) {
            let message = format!(
                "GPU `{}` has no host, but `{}` has one: give all GPUs a host or none",
                gpus[without].name, gpu.name
            );
            return Err(Fault { place: Place::Gpu(without), message });
        }
        check_name(host).map_err(|message| Fault { place: Place::Gpu(i), message: format!("host: {message}") })?;
        let number = names.iter().position(|name| name == host).unwrap_or_else(|| {
            names.push(host);
            names.len() - 1
        });
        // A wrong id has a sentence of its own.
        if let Some(of_gpu) = hosts.get_mut(gpu.id) {
            *of_gpu = number;
        }
    }
    Ok(hosts)
}

fn parts_of(raw: RawTopology) -> Parts {
    Parts {
        name: raw.name,
        device: raw.device.into_inner(),
        gpus: raw.gpus.into_iter().map(Spanned::into_inner).map(|gpu| (gpu.id, gpu.name)).collect(),
        switches: raw.switches.into_iter().map(Spanned::into_inner).collect(),
        links: raw
            .links
            .into_iter()
            .map(Spanned::into_inner)
            .map(|RawLink { between, bandwidth_gb_s, latency_us, duplex }| {
                (between, Link { ends: [0, 0], bandwidth_gb_s, latency_us, duplex })
            })
            .collect(),
        gpus_forward: raw.gpus_forward,
    }
}

/// Byte offsets at which the parts of a file start.
struct Starts {
    device: usize,
    gpus: Vec<usize>,
    switches: Vec<usize>,
    links: Vec<usize>,
}

impl Starts {
    fn of(&self, place: Place) -> Option<usize> {
        match place {
            Place::Whole => None,
            Place::Device => Some(self.device),
            Place::Gpu(i) => self.gpus.get(i).copied(),
            Place::Switch(i) => self.switches.get(i).copied(),
            Place::Link(i) => self.links.get(i).copied(),
        }
    }
}

/// Line, counting from 1, of a byte offset.
fn line_of(bytes: &[u8], offset: usize) -> usize {
    1 + bytes.iter().take(offset).filter(|byte| **byte == b'\n').count()
}

/// The TOML reader quotes what it found; a sentence has no line breaks and no control characters.
fn one_line(message: &str) -> String {
    message.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}
