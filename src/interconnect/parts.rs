//! The parts that a topology is put together from, not checked yet: links, devices, names, and the graph for routing.

/// Most GPUs (= ranks) that a topology may have.
pub const MAX_GPUS: usize = 512;
/// Most switches and links: far more than so many GPUs need, few enough to route at once.
pub(super) const MAX_SWITCHES: usize = 1024;
pub(super) const MAX_LINKS: usize = 4096;
pub(super) const MAX_NAME_CHARS: usize = 64;

/// True if the two directions of a link share its bandwidth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Duplex {
    /// Each direction has the whole bandwidth.
    Full,
    /// Both directions share the bandwidth.
    Half,
}

/// A cable or bus between two nodes. Nodes are numbered GPUs first (node = GPU id), then switches in file order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Link {
    /// The two nodes that it joins.
    pub ends: [usize; 2],
    /// Usable bandwidth, 10^9 bytes/s: per direction if full duplex, of both directions together if half duplex.
    pub bandwidth_gb_s: f64,
    /// Time that a transfer needs for this link on top of its bytes, microseconds.
    pub latency_us: f64,
    /// True if the directions share the bandwidth.
    pub duplex: Duplex,
}

/// The GPU that sits at every leaf.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceModel {
    /// Name of the product, as its maker writes it.
    pub name: String,
    /// Device memory, 10^9 bytes.
    pub memory_gb: f64,
    /// Bandwidth of the device memory, 10^9 bytes/s.
    pub bandwidth_gb_s: f64,
    /// Single-precision rate, 10^9 operations/s.
    pub gflops: f64,
    /// Time to start a kernel, besides its work, microseconds.
    #[serde(default = "DeviceModel::usual_launch_us")]
    pub launch_us: f64,
}

impl DeviceModel {
    /// Launch cost where a file states none: what back-to-back kernels of one stream cost on current GPUs, about.
    pub(super) fn usual_launch_us() -> f64 {
        3.0
    }

    /// Modeled time of a kernel that moves `bytes` and computes `flops`: the slower of the two, after its launch.
    pub fn kernel_s(&self, bytes: f64, flops: f64) -> f64 {
        self.launch_us * 1e-6 + (bytes / (self.bandwidth_gb_s * 1e9)).max(flops / (self.gflops * 1e9))
    }
}

/// An unchecked topology: what a file or a generator states.
pub(super) struct Parts {
    pub name: String,
    pub device: DeviceModel,
    /// (id, name) in the order stated.
    pub gpus: Vec<(usize, String)>,
    /// The first one is the root.
    pub switches: Vec<String>,
    /// Ends by name, then the link's numbers (its `ends` are filled in by the check).
    pub links: Vec<([String; 2], Link)>,
    pub gpus_forward: bool,
}

/// The faulty part of a topology; the file reader turns it into a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    Whole,
    Device,
    Gpu(usize),
    Switch(usize),
    Link(usize),
}

/// Why [`Parts`] do not make a topology.
#[derive(Debug)]
pub(super) struct Fault {
    pub place: Place,
    pub message: String,
}

pub(super) fn fault<T>(place: Place, message: String) -> Result<T, Fault> {
    Err(Fault { place, message })
}

/// Input of routing.
pub(super) struct Graph<'a> {
    pub nodes: usize,
    pub gpus: usize,
    pub links: &'a [Link],
    pub gpus_forward: bool,
}
