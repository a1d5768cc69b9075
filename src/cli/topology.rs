//! `loomtree topology detect`: a topology file for the machine it runs on, as far as the system tells: GPUs from the graphics
//! interface, the PCIe tree and its links from sysfs (Linux). What the system does not tell is assumed, and the file says
//! so in its first lines.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Subcommand;

use super::{CliError, print};
use crate::gpu::{AdapterKind, AdapterSummary, adapters};
use crate::interconnect::{MAX_GPUS, Topology};
use crate::output::write_atomically;

/// Arguments of `loomtree topology`.
#[derive(Clone, Debug, clap::Args)]
pub struct TopologyArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Clone, Debug, Subcommand)]
enum What {
    /// Write a topology file for this machine
    Detect(DetectArgs),
}

/// Arguments of `loomtree topology detect`.
#[derive(Clone, Debug, clap::Args)]
pub struct DetectArgs {
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
    let text = detect(&args, Path::new("/sys"), &adapters())?;
    match &args.out {
        None => print(&text)?,
        Some(path) => write_atomically(path, |out| out.write_all(text.as_bytes()))
            .map_err(|error| CliError::failed(format!("--out: {error}")))?,
    }
    Ok(())
}

/// Share of the wire rate that copies reach, as in the shipped files: 12 of 15.75 GB/s.
const USABLE: f64 = 12.0 / 15.75;
/// PCIe 3 x16, usable: where the system does not tell.
const ASSUMED_GB_S: f64 = 12.0;
const ASSUMED_LATENCY_US: f64 = 2.0;
const ASSUMED_DEVICE_GB_S: f64 = 500.0;
const ASSUMED_GFLOPS: f64 = 10_000.0;
const ASSUMED_MEMORY_GB: f64 = 8.0;

/// The text of the file. `sysfs`: where the system shows its devices; `found`: adapters of the graphics interface.
pub fn detect(args: &DetectArgs, sysfs: &Path, found: &[AdapterSummary]) -> Result<String, CliError> {
    let mut notes = Vec::new();
    let hardware: Vec<&AdapterSummary> = found.iter().filter(|adapter| adapter.kind != AdapterKind::Software).collect();
    let mut tree = PciTree::read(sysfs);
    if tree.gpus.len() > MAX_GPUS {
        notes.push(format!("{} GPUs found, the first {MAX_GPUS} are kept", tree.gpus.len()));
        tree.gpus.truncate(MAX_GPUS);
    }
    let mut parts = Parts::default();
    if tree.gpus.is_empty() {
        let count = hardware.iter().filter(|a| a.kind == hardware[0].kind && a.backend == hardware[0].backend).count();
        notes.push(match count {
            0 => "no GPU found: the processor stands for one".to_string(),
            n => format!("{n} adapter(s) found but no PCI device of theirs: a star of PCIe 3 x16 links is assumed"),
        });
        parts.star(count.max(1));
    } else {
        parts.add_tree(&tree, &mut notes);
    }
    if !hardware.is_empty() && !tree.gpus.is_empty() && tree.gpus.len() != hardware.len() {
        notes.push(format!(
            "PCI shows {} display controllers, the graphics interface {} hardware adapters; the PCI tree is taken",
            tree.gpus.len(),
            hardware.len()
        ));
    }
    notes.push(format!("latency of every link: {ASSUMED_LATENCY_US} us is assumed"));
    let mut given = |what: &str, given: Option<f64>, assumed: f64, told: Option<f64>| {
        let (value, origin) = match (given, told) {
            (Some(value), _) => (value, "given on the command line"),
            (None, Some(value)) => (value, "told by the system"),
            (None, None) => (assumed, "assumed, not known"),
        };
        notes.push(format!("{what}: {origin}"));
        value
    };
    let memory = given("memory of a GPU", args.memory, ASSUMED_MEMORY_GB, tree.memory_gb);
    let bandwidth = given("memory bandwidth of a GPU", args.bandwidth, ASSUMED_DEVICE_GB_S, None);
    let gflops = given("flop rate of a GPU", args.gflops, ASSUMED_GFLOPS, None);
    let device = hardware.first().map_or("unknown device", |adapter| adapter.name.as_str());
    let text = parts.text(&notes, device, [memory, bandwidth, gflops]);
    // Whatever was found, the file must be one that the other commands take.
    Topology::parse(text.as_bytes(), "detected topology").map_err(CliError::bad_input)?;
    Ok(text)
}

/// Display controllers and what lies between them and the processor.
#[derive(Default)]
struct PciTree {
    /// Path of every GPU from the root complex down, ascending: `[pci0000:00, 0000:00:01.0, 0000:01:00.0]`.
    gpus: Vec<Vec<String>>,
    /// Usable GB/s of the link above a device, where the system tells.
    links: BTreeMap<String, f64>,
    memory_gb: Option<f64>,
}

impl PciTree {
    fn read(sysfs: &Path) -> PciTree {
        let mut tree = PciTree::default();
        let entries = std::fs::read_dir(sysfs.join("bus/pci/devices")).into_iter().flatten().flatten();
        let mut folders: Vec<PathBuf> = entries.filter_map(|entry| entry.path().canonicalize().ok()).collect();
        folders.sort();
        for folder in folders {
            let text = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap_or_default();
            // Base class 3: display controllers, compute accelerators among them.
            if !text("class").trim().starts_with("0x03") {
                continue;
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
    // 8b/10b up to PCIe 2, 128b/130b from PCIe 3.
    let coding = if gigatransfers < 8.0 { 0.8 } else { 128.0 / 130.0 };
    let rate = gigatransfers * lanes * coding / 8.0 * USABLE;
    (rate > 0.0).then_some(rate)
}

#[derive(Default)]
struct Parts {
    switches: Vec<String>,
    gpus: Vec<String>,
    /// Ends and GB/s.
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

    /// Adds what hangs below `parent`: `paths` start with its children. Bridges with one child only are passed over;
    /// `above` is the narrowest link of those passed over.
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

    fn text(&self, notes: &[String], device: &str, rates: [f64; 3]) -> String {
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
        let [memory, bandwidth, gflops] = rates;
        let _ = writeln!(
            text,
            "]\n\n[device]\nname = {}\nmemory_gb = {memory:?}\nbandwidth_gb_s = {bandwidth:?}\ngflops = {gflops:?}",
            quoted(device)
        );
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOTHING: DetectArgs = DetectArgs { out: None, bandwidth: None, gflops: None, memory: None };

    /// A sysfs with devices at these paths: (path below `devices`, class, speed, width).
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
        let text = detect(&NOTHING, root.path(), &[]).unwrap();
        let topology = Topology::parse(text.as_bytes(), "found").unwrap();
        assert_eq!((topology.gpus(), topology.is_tree()), (3, true), "{text}");
        let narrowest = |from: usize, to: usize| {
            let rates = topology.path(from, to).iter().map(|hop| topology.links()[hop.link].bandwidth_gb_s);
            rates.fold(f64::INFINITY, f64::min)
        };
        // x8 of PCIe 4; the third one's root port is PCIe 3 x16.
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
        let text = detect(&args, root.path(), &[]).unwrap();
        let topology = Topology::parse(text.as_bytes(), "found").unwrap();
        assert_eq!((topology.gpus(), topology.device().bandwidth_gb_s), (1, 20.0));
        assert!(text.contains("no GPU found") && text.contains("given on the command line"), "{text}");
        let negative = DetectArgs { memory: Some(-1.0), ..NOTHING };
        assert_eq!(detect(&negative, root.path(), &[]).unwrap_err().exit_code, 2);
    }
}
