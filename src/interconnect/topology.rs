//! The switch graph of a machine: GPUs, switches, links, and the model of one GPU. Does not read files and does not
//! know what is sent; bandwidths and latencies are what the author of the topology stated, never measured here.

use super::parts::{DeviceModel, Duplex, Fault, Graph, Link, MAX_GPUS, Parts, Place, fault};
use super::routing::{Hop, Routes};
use super::topology_error::TopologyError;
use super::validate::{check_connected, check_device, check_links, check_name, check_names, names_by_id};

/// A machine: connected, with GPU ids 0..n-1 and a path between every two GPUs.
#[derive(Clone, Debug)]
pub struct Topology {
    name: String,
    device: DeviceModel,
    gpu_names: Vec<String>,
    switch_names: Vec<String>,
    links: Vec<Link>,
    gpus_forward: bool,
    routes: Routes,
    /// By GPU: number of its host.
    hosts: Vec<usize>,
}

impl Topology {
    /// The topology of a run that names none: a balanced binary tree of PCIe 3 x16 links (12 GB/s usable, full duplex)
    /// over `gpus` GPUs, which takes the same schedules as the machines of [Li et al. 2020, Sec. 5].
    /// Fails if `gpus` is not within 1..=[`MAX_GPUS`].
    pub fn default_for(gpus: usize) -> Result<Topology, TopologyError> {
        Topology::balanced_tree(gpus, 12.0, 2.0, Duplex::Full)
    }

    /// A balanced binary tree of equal links; the left half takes the larger part. A single GPU has no switch.
    /// Fails if `gpus` is not within 1..=[`MAX_GPUS`] or a link's number is out of range.
    pub fn balanced_tree(
        gpus: usize,
        bandwidth_gb_s: f64,
        latency_us: f64,
        duplex: Duplex,
    ) -> Result<Topology, TopologyError> {
        if gpus == 0 || gpus > MAX_GPUS {
            return Err(TopologyError::GpuCount { gpus });
        }
        let device = DeviceModel {
            name: "NVIDIA Titan Xp".into(),
            memory_gb: 12.0,
            bandwidth_gb_s: 547.7,
            gflops: 12_150.0,
            launch_us: DeviceModel::usual_launch_us(),
        };
        let link = Link { ends: [0, 0], bandwidth_gb_s, latency_us, duplex };
        let mut parts = Parts {
            name: format!("balanced tree of {gpus}"),
            device,
            gpus: (0..gpus).map(|id| (id, format!("gpu{id}"))).collect(),
            switches: Vec::new(),
            links: Vec::new(),
            gpus_forward: false,
        };
        grow(&mut parts, 0, gpus, link);
        Topology::build(parts).map_err(|fault| TopologyError::Malformed {
            file: format!("balanced tree of {gpus}"),
            line: None,
            message: fault.message,
        })
    }

    /// The same machine with GPUs 0..`gpus` only (all switches stay): for a run with fewer workers than the machine has
    /// GPUs. Fails if the machine has fewer, or if the rest is no longer connected.
    pub fn with_first_gpus(&self, gpus: usize) -> Result<Topology, TopologyError> {
        if gpus == 0 || gpus > self.gpus() {
            return Err(TopologyError::TooFewGpus { name: self.name.clone(), has: self.gpus(), asked: gpus });
        }
        let kept = |node: usize| node < gpus || node >= self.gpus();
        let parts = Parts {
            name: self.name.clone(),
            device: self.device.clone(),
            gpus: self.gpu_names[..gpus].iter().cloned().enumerate().collect(),
            switches: self.switch_names.clone(),
            links: self
                .links
                .iter()
                .filter(|link| link.ends.into_iter().all(kept))
                .map(|link| (link.ends.map(|node| self.node_name(node).to_owned()), *link))
                .collect(),
            gpus_forward: self.gpus_forward,
        };
        let cut = Topology::build(parts).map(|cut| cut.with_hosts(self.hosts[..gpus].to_vec()));
        cut.map_err(|fault| TopologyError::Malformed {
            file: format!("{} cut to {gpus} GPUs", self.name),
            line: None,
            message: fault.message,
        })
    }

    /// Checks everything that is promised on [`Topology`] and finds all paths.
    pub(super) fn build(parts: Parts) -> Result<Topology, Fault> {
        let Parts { name, device, gpus, switches, links, gpus_forward } = parts;
        check_device(&device)?;
        if let Err(message) = check_name(&name) {
            return fault(Place::Whole, format!("name: {message}"));
        }
        let gpu_names = names_by_id(&gpus)?;
        let node_of_name = check_names(&gpus, &switches)?;
        let links = check_links(links, &node_of_name)?;
        let nodes = gpu_names.len() + switches.len();
        let graph = Graph { nodes, gpus: gpu_names.len(), links: &links, gpus_forward };
        check_connected(&graph, &gpus, &switches)?;
        let routes = match Routes::find(&graph) {
            Ok(routes) => routes,
            Err((from, to)) => {
                return fault(
                    Place::Gpu(gpus.iter().position(|(id, _)| *id == to).unwrap_or(0)),
                    format!(
                        "GPU `{}` reaches GPU `{}` only through other GPUs: add a link, or set gpus_forward = true \
                         if these GPUs pass transfers on",
                        gpu_names[from], gpu_names[to]
                    ),
                );
            }
        };
        let hosts = vec![0; gpu_names.len()];
        Ok(Topology { name, device, gpu_names, switch_names: switches, links, gpus_forward, routes, hosts })
    }

    /// GPUs of the machine; the largest possible number of ranks.
    pub fn gpus(&self) -> usize {
        self.gpu_names.len()
    }

    /// By GPU: number of its host, all the same where the file names no hosts.
    pub fn hosts(&self) -> &[usize] {
        &self.hosts
    }

    /// The same machine with its GPUs on these hosts.
    pub(super) fn with_hosts(self, hosts: Vec<usize>) -> Topology {
        Topology { hosts, ..self }
    }

    /// Name of the machine.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The model of the GPU that sits at every leaf.
    pub fn device(&self) -> &DeviceModel {
        &self.device
    }

    /// The same links with another device on every GPU.
    pub fn with_device(&self, device: DeviceModel) -> Topology {
        Topology { device, ..self.clone() }
    }

    /// Number of nodes: GPUs and switches.
    pub fn nodes(&self) -> usize {
        self.gpu_names.len() + self.switch_names.len()
    }

    /// All links, in file order.
    pub fn links(&self) -> &[Link] {
        &self.links
    }

    /// Name of a GPU (node = id) or switch (nodes after the GPUs).
    ///
    /// # Panics
    /// If there is no such node.
    pub fn node_name(&self, node: usize) -> &str {
        if node < self.gpus() { &self.gpu_names[node] } else { &self.switch_names[node - self.gpus()] }
    }

    /// The links from GPU `from` to GPU `to` in order: widest path first, then fewest links, then first in the file.
    /// Empty if both are the same.
    ///
    /// # Panics
    /// If there is no such GPU.
    pub fn path(&self, from: usize, to: usize) -> &[Hop] {
        self.routes.path(from, to)
    }

    /// Seconds for `bytes` between the two GPUs that are farthest apart, alone on their way; 0 with one GPU.
    pub fn farthest_s(&self, bytes: f64) -> f64 {
        let way = |from: usize, to: usize| -> f64 {
            let links = self.path(from, to).iter().map(|hop| &self.links[hop.link]);
            let (latency_us, narrowest) = links.fold((0.0, f64::INFINITY), |(latency, narrowest), link| {
                (latency + link.latency_us, f64::min(narrowest, link.bandwidth_gb_s))
            });
            latency_us * 1e-6 + bytes / (narrowest * 1e9)
        };
        let pairs = (0..self.gpus()).flat_map(|from| (0..self.gpus()).map(move |to| (from, to)));
        pairs.filter(|(from, to)| from != to).map(|(from, to)| way(from, to)).fold(0.0, f64::max)
    }

    /// The root switch's node: the first switch of the file. None without switches.
    pub fn root(&self) -> Option<usize> {
        (!self.switch_names.is_empty()).then_some(self.gpus())
    }

    /// True if there is exactly one way between any two nodes.
    pub fn is_tree(&self) -> bool {
        // Connected is checked on construction.
        self.links.len() + 1 == self.gpus() + self.switch_names.len()
    }

    /// GPUs in depth-first order from the root (GPU 0 without switches), links in file order: in a tree, neighbors in
    /// this order share the lowest switches, and going round once uses every link once in each direction.
    pub fn leaf_order(&self) -> Vec<usize> {
        let nodes = self.gpus() + self.switch_names.len();
        let mut neighbors = vec![Vec::new(); nodes];
        for link in &self.links {
            let [a, b] = link.ends;
            neighbors[a].push(b);
            neighbors[b].push(a);
        }
        let mut seen = vec![false; nodes];
        let mut stack = vec![self.root().unwrap_or(0)];
        let mut order = Vec::with_capacity(self.gpus());
        while let Some(node) = stack.pop() {
            if std::mem::replace(&mut seen[node], true) {
                continue;
            }
            if node < self.gpus() {
                order.push(node);
            }
            stack.extend(neighbors[node].iter().rev().filter(|next| !seen[**next]));
        }
        order
    }
}

/// Adds the subtree over GPUs `first..first + count`; returns the name of its top node.
fn grow(parts: &mut Parts, first: usize, count: usize, link: Link) -> String {
    if count == 1 {
        return format!("gpu{first}");
    }
    let top = format!("switch{}", parts.switches.len());
    parts.switches.push(top.clone());
    let left = count.div_ceil(2);
    for (first, count) in [(first, left), (first + left, count - left)] {
        // A switch's link to its left half stands before the one to its right half: `leaf_order` follows file order.
        let child = grow(parts, first, count, link);
        parts.links.push(([top.clone(), child], link));
    }
    top
}
