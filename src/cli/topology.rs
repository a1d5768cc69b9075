//! `loomtree topology detect`: writes a topology file for this machine. GPUs come from the graphics interface, the PCIe
//! tree and its links from sysfs (Linux). Values that the system does not provide are assumed; the first lines of the
//! file list them.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Subcommand;
use serde_json::json;

use super::launcher::{self, LauncherArgs};
use super::{CliError, answer, topology_hosts};
use crate::gpu::{AdapterKind, AdapterSummary, Executor, adapters, bandwidth_gb_s};
use crate::interconnect::{MAX_GPUS, Topology};
use crate::os::console::is_json;
use crate::output::write_atomically;
use crate::transport::{MeasuredWorld, cores};

/// Arguments of `loomtree topology`.
#[derive(Clone, Debug, clap::Args)]
pub struct TopologyArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Clone, Debug, Subcommand)]
enum What {
    /// Write a topology file for this machine, or for the hosts of mpirun's ranks and the links between them
    Detect(DetectArgs),
}

/// Arguments of `loomtree topology detect`.
#[derive(Clone, Debug, clap::Args)]
pub struct DetectArgs {
    /// Who starts the ranks.
    #[command(flatten)]
    pub launcher: LauncherArgs,
    /// File to write [default: print it]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Bandwidth of a GPU's memory, GB/s (`loomtree bench device` measures it)
    #[arg(long, value_name = "GB/S")]
    pub bandwidth: Option<f64>,
    /// Single-precision rate of a GPU, Gflop/s
    #[arg(long, value_name = "GFLOP/S")]
    pub gflops: Option<f64>,
    /// Memory of a GPU, GB
    #[arg(long, value_name = "GB")]
    pub memory: Option<f64>,
}

/// Runs the command.
pub fn run(args: TopologyArgs) -> Result<(), CliError> {
    let What::Detect(args) = args.what;
    launcher::with_all(&args.launcher, |ranks| {
        let text = detect(&args, Path::new("/sys"), &adapters(), measured)?;
        write(&args, &ranks.map_or(Ok(text.clone()), |ranks| of_hosts(ranks, &text))?)
    })
}

fn write(args: &DetectArgs, text: &str) -> Result<(), CliError> {
    if let Some(path) = &args.out {
        write_atomically(path, |out| out.write_all(text.as_bytes()))
            .map_err(|error| CliError::failed(format!("--out: {error}")))?;
        if !is_json() {
            return Ok(());
        }
    }
    let document = || {
        let topology = text.parse::<toml::Table>().ok().and_then(|table| serde_json::to_value(table).ok());
        json!({ "file": args.out, "topology": topology })
    };
    answer(text, document)
}

/// The text of a topology of the hosts of ranks, with the device of this host, whose own topology is `text`.
fn of_hosts(world: &MeasuredWorld, text: &str) -> Result<String, CliError> {
    let own = Topology::parse(text.as_bytes(), "detected topology").map_err(CliError::bad_input)?;
    let of_device = |note: &&str| note.contains("of a GPU:") || note.contains("no GPU found");
    let notes = text.lines().filter_map(|line| line.strip_prefix("# - ")).filter(of_device).map(str::to_string);
    topology_hosts::text(world, own.device(), &notes.collect::<Vec<_>>())
}

/// Fraction of the wire rate that copies reach, as in the shipped files: 12 of 15.75 GB/s.
const USABLE: f64 = 12.0 / 15.75;
/// Usable rate of PCIe 3 x16, assumed if the system does not report the link.
const ASSUMED_GB_S: f64 = 12.0;
const ASSUMED_LATENCY_US: f64 = 2.0;
const ASSUMED_DEVICE_GB_S: f64 = 500.0;
const ASSUMED_GFLOPS: f64 = 10_000.0;
const ASSUMED_MEMORY_GB: f64 = 8.0;

/// A device whose memory bandwidth is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Device {
    /// The processor, if there is no GPU.
    Processor,
    /// An adapter of the graphics interface.
    Adapter(usize),
}

/// Memory bandwidth of a device by copying, GB/s; none if it cannot be measured.
fn measured(device: Device) -> Option<f64> {
    /// Well above the size of the last-level cache, yet copied in well under a second.
    const BYTES: usize = 256 << 20;
    let executor = match device {
        Device::Processor => Executor::cpu(cores()),
        Device::Adapter(index) => Executor::gpu(Some(index), 0).ok()?,
    };
    bandwidth_gb_s(&executor, BYTES).ok().map(|measured| (measured.copy_gb_s * 10.0).round() / 10.0)
}

/// A value in the file and its origin.
struct Figure {
    value: f64,
    origin: &'static str,
}

/// Generates the text of the file. `sysfs`: folder in which the system shows its devices. `found`: adapters of the
/// graphics interface. `measure`: measures the memory bandwidth of a device, if possible.
pub fn detect(
    args: &DetectArgs,
    sysfs: &Path,
    found: &[AdapterSummary],
    measure: impl FnOnce(Device) -> Option<f64>,
) -> Result<String, CliError> {
    let mut notes = Vec::new();
    let hardware: Vec<&AdapterSummary> = found.iter().filter(|adapter| adapter.kind != AdapterKind::Software).collect();
    let mut tree = PciTree::read(sysfs);
    notes.append(&mut tree.left_out);
    if tree.gpus.len() > MAX_GPUS {
        notes.push(format!("{} GPUs found, the first {MAX_GPUS} are kept", tree.gpus.len()));
        tree.gpus.truncate(MAX_GPUS);
    }
    let mut parts = Parts::default();
    let mut to_measure = hardware.first().map(|adapter| Device::Adapter(adapter.index));
    if tree.gpus.is_empty() {
        let count = hardware.iter().filter(|a| a.kind == hardware[0].kind && a.backend == hardware[0].backend).count();
        notes.push(match count {
            0 => "no GPU found: the processor stands for one".to_string(),
            n => format!("{n} adapter(s) found but no PCI device of theirs: a star of PCIe 3 x16 links is assumed"),
        });
        to_measure = to_measure.or(Some(Device::Processor));
        parts.star(count.max(1));
    } else {
        parts.add_tree(&tree, &mut notes);
    }
    if !hardware.is_empty() && !tree.gpus.is_empty() && tree.gpus.len() != hardware.len() {
        notes.push(format!(
            "PCI shows {} compute devices, the graphics interface {} hardware adapters; the PCI tree is taken",
            tree.gpus.len(),
            hardware.len()
        ));
    }
    if parts.gpus.len() > 1 {
        notes.push(
            "links between GPUs beside PCIe (NVLink, xGMI) are not shown by sysfs and are left out: if `nvidia-smi topo -m` or \
             `rocm-smi --showtopo` shows some, add them to `links`"
                .into(),
        );
    }
    notes.push(format!("latency of every link: {ASSUMED_LATENCY_US} us is assumed"));
    let given = |given: Option<f64>, known: Option<Figure>, assumed: f64| match (given, known) {
        (Some(value), _) => Figure { value, origin: "given on the command line" },
        (None, Some(figure)) => figure,
        (None, None) => Figure { value: assumed, origin: "assumed, not known" },
    };
    let told = |value: f64| Figure { value, origin: "told by the system" };
    let memory_gb = tree.memory_gb.or_else(|| (to_measure == Some(Device::Processor)).then(main_memory_gb).flatten());
    let bandwidth = match args.bandwidth {
        None => to_measure.and_then(measure).map(|value| Figure { value, origin: "measured" }),
        Some(_) => None,
    };
    let figures = [
        given(args.memory, memory_gb.map(told), ASSUMED_MEMORY_GB),
        given(args.bandwidth, bandwidth, ASSUMED_DEVICE_GB_S),
        given(args.gflops, None, ASSUMED_GFLOPS),
    ];
    for (what, figure) in ["memory", "memory bandwidth", "flop rate"].iter().zip(&figures) {
        notes.push(format!("{what} of a GPU: {}", figure.origin));
    }
    let device = match to_measure {
        Some(Device::Processor) => "processor",
        _ => hardware.first().map_or("unknown device", |adapter| adapter.name.as_str()),
    };
    let text = parts.text(&notes, device, &figures);
    // The generated file must be valid for the other commands.
    Topology::parse(text.as_bytes(), "detected topology").map_err(CliError::bad_input)?;
    Ok(text)
}

/// Main memory of the machine, GB.
fn main_memory_gb() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let kib: f64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some((kib * 1024.0 / 1e8).round() / 10.0)
}

/// PCI vendors whose display controllers can compute: AMD, NVIDIA, Intel, Moore Threads. Display controllers of other
/// vendors (management boards, virtual machines) only drive screens.
const COMPUTE_VENDORS: [&str; 4] = ["0x1002", "0x10de", "0x8086", "0x1ed5"];

/// True for a compute device, false for a device of another kind. An error is the reason why a possible GPU is not
/// used.
fn computes(class: &str, vendor: &str) -> Result<bool, &'static str> {
    match class.get(..6) {
        // 3D controllers (GPUs without a screen) and processing accelerators.
        Some("0x0302" | "0x1200") => Ok(true),
        Some("0x0300" | "0x0380") if COMPUTE_VENDORS.contains(&vendor) => Ok(true),
        Some(class) if class.starts_with("0x03") => Err("it only draws screens"),
        _ => Ok(false),
    }
}

/// Compute devices and the PCIe bridges between them and the processor.
#[derive(Default)]
struct PciTree {
    /// Path of every GPU from the root complex down, ascending: `[pci0000:00, 0000:00:01.0, 0000:01:00.0]`.
    gpus: Vec<Vec<String>>,
    /// Usable GB/s of the link above a device, if the system reports it.
    links: BTreeMap<String, f64>,
    memory_gb: Option<f64>,
    /// Possible GPUs that are not used, with the reason.
    left_out: Vec<String>,
}

impl PciTree {
    fn read(sysfs: &Path) -> PciTree {
        let mut tree = PciTree::default();
        let entries = std::fs::read_dir(sysfs.join("bus/pci/devices")).into_iter().flatten().flatten();
        let mut folders: Vec<PathBuf> = entries.filter_map(|entry| entry.path().canonicalize().ok()).collect();
        folders.sort();
        for folder in folders {
            let text = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap_or_default();
            let vendor = text("vendor");
            match computes(text("class").trim(), vendor.trim()) {
                Ok(true) => {}
                Ok(false) => continue,
                Err(why) => {
                    let name = folder.file_name().unwrap_or_default().to_string_lossy();
                    tree.left_out
                        .push(format!("display controller {name} of vendor {} is left out: {why}", vendor.trim()));
                    continue;
                }
            }
            let is_pci = |part: &&str| part.starts_with("pci") || part.split(':').count() == 3;
            let path: Vec<String> = folder
                .components()
                .filter_map(|part| part.as_os_str().to_str())
                .filter(is_pci)
                .map(str::to_string)
                .collect();
            for ancestor in folder.ancestors().take(path.len()) {
                if let (Some(name), Some(rate)) = (ancestor.file_name().and_then(|n| n.to_str()), link_rate(ancestor)) {
                    tree.links.insert(name.to_string(), rate);
                }
            }
            if let Ok(bytes) = text("mem_info_vram_total").trim().parse::<f64>() {
                tree.memory_gb = Some(bytes / 1e9);
            }
            tree.gpus.push(path);
        }
        // An integrated GPU is attached to the root complex. It is skipped if there are others, because it then drives
        // the screen.
        if tree.gpus.iter().any(|path| path.len() > 2) {
            let (others, own): (Vec<_>, Vec<_>) = tree.gpus.into_iter().partition(|path| path.len() > 2);
            tree.gpus = others;
            for path in own {
                let name = path.last().map_or("", String::as_str);
                tree.left_out
                    .push(format!("GPU {name} is left out: it is part of the processor, and there are others"));
            }
        }
        tree
    }
}

/// Usable GB/s per direction of the link above a PCI device.
fn link_rate(folder: &Path) -> Option<f64> {
    let text = |name: &str| std::fs::read_to_string(folder.join(name)).ok();
    let speed = text("current_link_speed").or_else(|| text("max_link_speed"))?;
    let width = text("current_link_width").or_else(|| text("max_link_width"))?;
    let gigatransfers: f64 = speed.split_whitespace().next()?.parse().ok()?;
    let lanes: f64 = width.trim().parse().ok()?;
    // PCIe 1 and 2 use 8b/10b coding, PCIe 3 and later 128b/130b.
    let coding = if gigatransfers < 8.0 { 0.8 } else { 128.0 / 130.0 };
    let rate = gigatransfers * lanes * coding / 8.0 * USABLE;
    (rate > 0.0).then_some(rate)
}

#[derive(Default)]
struct Parts {
    switches: Vec<String>,
    gpus: Vec<String>,
    /// Both ends and GB/s of every link.
    links: Vec<(String, String, f64)>,
}

impl Parts {
    fn star(&mut self, count: usize) {
        self.gpus = (0..count).map(|id| format!("gpu{id}")).collect();
        if count > 1 {
            self.switches.push("host".into());
            self.links = self.gpus.iter().map(|gpu| ("host".into(), gpu.clone(), ASSUMED_GB_S)).collect();
        }
    }

    fn add_tree(&mut self, tree: &PciTree, notes: &mut Vec<String>) {
        if tree.gpus.len() == 1 {
            self.gpus.push(tree.gpus[0].last().cloned().unwrap_or_default());
            return;
        }
        self.switches.push("host".into());
        let all: Vec<&[String]> = tree.gpus.iter().map(Vec::as_slice).collect();
        let mut unknown = Vec::new();
        self.grow("host", &all, f64::INFINITY, tree, &mut unknown);
        if !unknown.is_empty() {
            notes.push(format!("links above {}: {ASSUMED_GB_S} GB/s (PCIe 3 x16) is assumed", unknown.join(", ")));
        }
        notes
            .push("processors are taken as one switch `host`: a slower link between sockets is not told by PCI".into());
    }

    /// Adds the devices below `parent`; `paths` start with its children. Bridges with a single child are skipped;
    /// `above` is the narrowest link of the skipped ones.
    fn grow(&mut self, parent: &str, paths: &[&[String]], above: f64, tree: &PciTree, unknown: &mut Vec<String>) {
        let mut children: BTreeMap<&str, Vec<&[String]>> = BTreeMap::new();
        for path in paths {
            children.entry(&path[0]).or_default().push(&path[1..]);
        }
        for (name, below) in children {
            let is_gpu = below.iter().any(|rest| rest.is_empty());
            let told = tree.links.get(name).copied();
            let mut rate = above.min(told.unwrap_or(f64::INFINITY));
            let first = |rest: &&[String]| rest.first().cloned();
            let single = !is_gpu && below.iter().all(|rest| first(rest) == first(&below[0]));
            if single {
                self.grow(parent, &below, rate, tree, unknown);
                continue;
            }
            if rate.is_infinite() {
                unknown.push(name.to_string());
                rate = ASSUMED_GB_S;
            }
            self.links.push((parent.into(), name.into(), rate));
            if is_gpu {
                self.gpus.push(name.into());
            } else {
                self.switches.push(name.into());
                self.grow(name, &below, f64::INFINITY, tree, unknown);
            }
        }
    }

    fn text(&self, notes: &[String], device: &str, figures: &[Figure; 3]) -> String {
        let mut text = String::from("# Written by `loomtree topology detect`. What it rests on:\n");
        let quoted = |name: &str| serde_json::Value::from(name.chars().take(64).collect::<String>()).to_string();
        // Writing to a String cannot fail.
        notes.iter().for_each(|note| {
            let _ = writeln!(text, "# - {note}");
        });
        let _ = writeln!(text, "\nname = \"detected\"");
        let switches: Vec<String> = self.switches.iter().map(|name| quoted(name)).collect();
        let _ = writeln!(text, "switches = [{}]", switches.join(", "));
        let _ = writeln!(text, "gpus = [");
        for (id, name) in self.gpus.iter().enumerate() {
            let _ = writeln!(text, "    {{ id = {id}, name = {} }},", quoted(name));
        }
        let _ = writeln!(text, "]\nlinks = [");
        for (a, b, rate) in &self.links {
            let _ = writeln!(
                text,
                "    {{ between = [{}, {}], bandwidth_gb_s = {rate:.2}, latency_us = {ASSUMED_LATENCY_US:.1}, duplex = \
                 \"full\" }},",
                quoted(a),
                quoted(b)
            );
        }
        let _ = writeln!(text, "]\n\n[device]\nname = {}", quoted(device));
        for (key, Figure { value, origin }) in ["memory_gb", "bandwidth_gb_s", "gflops"].iter().zip(figures) {
            let _ = writeln!(text, "{key} = {value:?}  # {origin}");
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOTHING: DetectArgs =
        DetectArgs { launcher: LauncherArgs::NONE, out: None, bandwidth: None, gflops: None, memory: None };

    /// A sysfs with these devices: (path below `devices`, class, speed, width).
    fn sysfs(devices: &[(&str, &str, &str, &str)]) -> tempfile::TempDir {
        let root = tempfile::tempdir().unwrap();
        let bus = root.path().join("bus/pci/devices");
        std::fs::create_dir_all(&bus).unwrap();
        for (path, class, speed, width) in devices {
            let folder = root.path().join("devices").join(path);
            std::fs::create_dir_all(&folder).unwrap();
            for (name, text) in [("class", class), ("current_link_speed", speed), ("current_link_width", width)] {
                std::fs::write(folder.join(name), text).unwrap();
            }
            std::os::unix::fs::symlink(&folder, bus.join(folder.file_name().unwrap())).unwrap();
        }
        root
    }

    #[test]
    fn a_switch_with_two_gpus_and_a_third_at_the_root_become_a_tree() {
        let (bridge, gpu) = ("0x060400", "0x030200");
        let root = sysfs(&[
            ("pci0000:00/0000:00:01.0", bridge, "16.0 GT/s PCIe", "16"),
            ("pci0000:00/0000:00:01.0/0000:01:00.0", bridge, "16.0 GT/s PCIe", "16"),
            ("pci0000:00/0000:00:01.0/0000:01:00.0/0000:02:00.0", gpu, "16.0 GT/s PCIe", "16"),
            ("pci0000:00/0000:00:01.0/0000:01:00.0/0000:03:00.0", gpu, "16.0 GT/s PCIe", "8"),
            ("pci0000:40/0000:40:01.0", bridge, "8.0 GT/s PCIe", "16"),
            ("pci0000:40/0000:40:01.0/0000:41:00.0", gpu, "16.0 GT/s PCIe", "16"),
            ("pci0000:00/0000:00:02.0", "0x010802", "8.0 GT/s PCIe", "4"),
        ]);
        let text = detect(&NOTHING, root.path(), &[], |_| None).unwrap();
        let topology = Topology::parse(text.as_bytes(), "found").unwrap();
        assert_eq!((topology.gpus(), topology.is_tree()), (3, true), "{text}");
        let narrowest = |from: usize, to: usize| {
            let rates = topology.path(from, to).iter().map(|hop| topology.links()[hop.link].bandwidth_gb_s);
            rates.fold(f64::INFINITY, f64::min)
        };
        // x8 of PCIe 4; the root port of the third device is PCIe 3 x16.
        assert!((narrowest(0, 1) - 12.0).abs() < 0.01 && (narrowest(0, 2) - 12.0).abs() < 0.01, "{text}");
        assert_eq!(
            topology.path(0, 1).len(),
            2,
            "the root complex and the port with one child are passed over\n{text}"
        );
        assert!(text.contains("assumed, not known") && text.contains("between sockets"), "{text}");
    }

    #[test]
    fn a_machine_that_tells_nothing_gets_one_gpu_and_the_file_says_so() {
        let root = sysfs(&[]);
        let args = DetectArgs { bandwidth: Some(20.0), ..NOTHING };
        let text = detect(&args, root.path(), &[], |_| panic!("it is given")).unwrap();
        let topology = Topology::parse(text.as_bytes(), "found").unwrap();
        assert_eq!((topology.gpus(), topology.device().bandwidth_gb_s), (1, 20.0));
        assert!(text.contains("no GPU found") && text.contains("given on the command line"), "{text}");
        let negative = DetectArgs { memory: Some(-1.0), ..NOTHING };
        assert_eq!(detect(&negative, root.path(), &[], |_| None).unwrap_err().exit_code, 2);
    }

    #[test]
    fn what_only_draws_screens_gets_no_rank_and_figures_say_where_they_come_from() {
        let (bridge, screen, gpu) = ("0x060400", "0x030000", "0x030200");
        let mut devices: Vec<(String, &str, &str, &str)> = vec![
            ("pci0000:00/0000:00:1c.0".into(), bridge, "5.0 GT/s PCIe", "1"),
            ("pci0000:00/0000:00:1c.0/0000:03:00.0".into(), bridge, "5.0 GT/s PCIe", "1"),
            ("pci0000:00/0000:00:1c.0/0000:03:00.0/0000:04:00.0".into(), screen, "Unknown", "0"),
            ("pci0000:00/0000:00:02.0".into(), screen, "Unknown", "0"),
        ];
        for bus in ["15", "37"] {
            devices.push((format!("pci0000:{bus}/0000:{bus}:01.0"), bridge, "32.0 GT/s PCIe", "16"));
            devices.push((format!("pci0000:{bus}/0000:{bus}:01.0/0000:{bus}:08.0"), gpu, "32.0 GT/s PCIe", "16"));
        }
        let listed: Vec<(&str, &str, &str, &str)> = devices.iter().map(|d| (&d.0[..], d.1, d.2, d.3)).collect();
        let root = sysfs(&listed);
        std::fs::write(root.path().join("devices/pci0000:00/0000:00:02.0/vendor"), "0x8086\n").unwrap();
        let text = detect(&NOTHING, root.path(), &[], |_| None).unwrap();
        let topology = Topology::parse(text.as_bytes(), "found").unwrap();
        assert_eq!((topology.gpus(), topology.links().len()), (2, 2), "{text}");
        assert!(topology.links().iter().all(|link| (link.bandwidth_gb_s - 48.01).abs() < 0.1), "{text}");
        for note in [
            "0000:04:00.0 of vendor  is left out",
            "0000:00:02.0 is left out",
            "NVLink",
            "bandwidth_gb_s = 500.0  # assumed",
        ] {
            assert!(text.contains(note), "{note}: {text}");
        }
        let nothing = sysfs(&[]);
        let text =
            detect(&NOTHING, nothing.path(), &[], |device| (device == Device::Processor).then_some(25.3)).unwrap();
        assert!(text.contains("bandwidth_gb_s = 25.3  # measured") && text.contains("memory_gb = "), "{text}");
    }
}
