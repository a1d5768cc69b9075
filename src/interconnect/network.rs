//! Bytes flowing over shared links in virtual time: every flow occupies all links of its path at once, and flows share
//! links max-min fairly (nobody can get more without taking from somebody who has less or the same). Latency is not in
//! here: it delays the arrival of a flow, not its use of the links.

use super::parts::Duplex;
use super::topology::Topology;

/// Rates within this factor of each other are one bottleneck; times within it are one moment.
const SAME: f64 = 1.0 + 1e-12;

/// The channels of a topology and the path of every pair of GPUs over them. A channel is one direction of a link, or a
/// whole half-duplex link.
#[derive(Clone, Debug)]
pub(super) struct Channels {
    gpus: usize,
    /// Capacity of each channel, bytes per second.
    pub capacity: Vec<f64>,
    /// `paths[from * gpus + to]`.
    paths: Vec<Vec<u32>>,
    latencies_s: Vec<f64>,
}

impl Channels {
    /// Channel of a link in a direction: 2 link (forward, or half duplex) or 2 link + 1.
    pub(super) fn of(topology: &Topology) -> Channels {
        let (gpus, links) = (topology.gpus(), topology.links());
        let capacity = links.iter().flat_map(|link| [link.bandwidth_gb_s * 1e9; 2]).collect();
        let (mut paths, mut latencies_s) = (Vec::with_capacity(gpus * gpus), Vec::with_capacity(gpus * gpus));
        for from in 0..gpus {
            for to in 0..gpus {
                let hops = topology.path(from, to);
                let channel = |link: usize, forward: bool| {
                    2 * link as u32 + u32::from(!forward && links[link].duplex == Duplex::Full)
                };
                paths.push(hops.iter().map(|hop| channel(hop.link, hop.forward)).collect());
                latencies_s.push(hops.iter().map(|hop| links[hop.link].latency_us * 1e-6).sum());
            }
        }
        Channels { gpus, capacity, paths, latencies_s }
    }

    /// Channels from GPU to GPU.
    pub(super) fn path(&self, from: usize, to: usize) -> &[u32] {
        &self.paths[from * self.gpus + to]
    }

    /// Sum of the latencies of a path, seconds.
    pub(super) fn latency_s(&self, from: usize, to: usize) -> f64 {
        self.latencies_s[from * self.gpus + to]
    }
}

struct Flow {
    id: usize,
    pair: usize,
    /// Bytes left at `since_s`.
    left: f64,
    since_s: f64,
    rate: f64,
    end_s: f64,
}

/// Flows that share the channels at the present time.
pub(super) struct Network<'a> {
    channels: &'a Channels,
    flows: Vec<Flow>,
    stale: bool,
    // Scratch of `share`.
    free: Vec<f64>,
    takers: Vec<u32>,
}

impl<'a> Network<'a> {
    pub(super) fn new(channels: &'a Channels) -> Network<'a> {
        let count = channels.capacity.len();
        Network { channels, flows: Vec::new(), stale: false, free: vec![0.0; count], takers: vec![0; count] }
    }

    /// Starts a flow at `now_s`, which must not lie before any earlier call. A flow without bytes or links ends at once.
    pub(super) fn start(&mut self, id: usize, from: usize, to: usize, bytes: f64, now_s: f64) {
        let pair = from * self.channels.gpus + to;
        self.flows.push(Flow { id, pair, left: bytes, since_s: now_s, rate: 0.0, end_s: f64::INFINITY });
        self.stale = true;
    }

    /// When the next flow ends, if nothing starts before.
    pub(super) fn next_end_s(&mut self, now_s: f64) -> f64 {
        if self.stale {
            self.share(now_s);
        }
        self.flows.iter().map(|flow| flow.end_s).fold(f64::INFINITY, f64::min)
    }

    /// Takes out the flows that have ended by `now_s`, in the order in which they were started.
    pub(super) fn ended(&mut self, now_s: f64, ended: &mut Vec<usize>) {
        ended.clear();
        self.flows.retain(|flow| {
            let done = flow.end_s <= now_s * SAME;
            if done {
                ended.push(flow.id);
            }
            !done
        });
        self.stale |= !ended.is_empty();
    }

    /// Gives every flow its rate: the most crowded channels first, until all flows have one (progressive filling).
    fn share(&mut self, now_s: f64) {
        self.stale = false;
        let paths = &self.channels.paths;
        for flow in &self.flows {
            for &channel in &paths[flow.pair] {
                self.free[channel as usize] = self.channels.capacity[channel as usize];
                self.takers[channel as usize] = 0;
            }
        }
        for flow in &self.flows {
            paths[flow.pair].iter().for_each(|&channel| self.takers[channel as usize] += 1);
        }
        let mut open: Vec<usize> = (0..self.flows.len()).collect();
        while !open.is_empty() {
            let share_of = |flow: &Flow, free: &[f64], takers: &[u32]| {
                let each = |channel: &u32| free[*channel as usize] / f64::from(takers[*channel as usize]);
                paths[flow.pair].iter().map(each).fold(f64::INFINITY, f64::min)
            };
            let shares: Vec<f64> = open.iter().map(|&i| share_of(&self.flows[i], &self.free, &self.takers)).collect();
            let least = shares.iter().copied().fold(f64::INFINITY, f64::min);
            let mut rest = Vec::with_capacity(open.len());
            for (&i, share) in open.iter().zip(&shares) {
                if *share > least * SAME {
                    rest.push(i);
                    continue;
                }
                let flow = &mut self.flows[i];
                for &channel in &paths[flow.pair] {
                    self.free[channel as usize] -= least;
                    self.takers[channel as usize] -= 1;
                }
                flow.set_rate(least, now_s);
            }
            open = rest;
        }
    }
}

impl Flow {
    fn set_rate(&mut self, rate: f64, now_s: f64) {
        if rate == self.rate {
            return;
        }
        self.left -= self.rate * (now_s - self.since_s);
        (self.since_s, self.rate) = (now_s, rate);
        // An infinite rate: no links between (the own rank).
        self.end_s = if self.left <= 0.0 || rate == f64::INFINITY { now_s } else { now_s + self.left / rate };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ends of flows (from, to, bytes), all started at 0.
    fn ends(topology: &Topology, flows: &[(usize, usize, f64)]) -> Vec<f64> {
        let channels = Channels::of(topology);
        let mut network = Network::new(&channels);
        for (id, &(from, to, bytes)) in flows.iter().enumerate() {
            network.start(id, from, to, bytes, 0.0);
        }
        let (mut now_s, mut found, mut ended) = (0.0, vec![0.0; flows.len()], Vec::new());
        while !network.flows.is_empty() {
            now_s = network.next_end_s(now_s);
            network.ended(now_s, &mut ended);
            ended.iter().for_each(|&id| found[id] = now_s);
        }
        found
    }

    fn tree(duplex: Duplex) -> Topology {
        Topology::balanced_tree(4, 1.0, 0.0, duplex).unwrap()
    }

    #[test]
    fn two_flows_into_one_gpu_share_its_link_and_the_short_one_leaves_first() {
        // Half a GB/s each until the short one ends at 2 s; the long one then has 2 GB left at full speed.
        assert_eq!(ends(&tree(Duplex::Full), &[(0, 1, 1e9), (2, 1, 3e9)]), [2.0, 4.0]);
    }

    #[test]
    fn what_a_bottleneck_leaves_over_goes_to_the_others() {
        // 0 -> 2 and 1 -> 3 cross the root together: 1/2 each. 0 -> 1 shares the egress of 0 with the first: gets 1/2.
        assert_eq!(ends(&tree(Duplex::Full), &[(0, 2, 1e9), (1, 3, 1e9), (0, 1, 1e9)]), [2.0, 2.0, 2.0]);
        // Three into GPU 3, one of them (0) also sends to 1: that one gets what its egress has left, 2/3.
        let found = ends(&tree(Duplex::Full), &[(0, 3, 1e9), (1, 3, 1e9), (2, 3, 1e9), (0, 1, 2e9)]);
        assert!(found.iter().all(|end_s| (end_s - 3.0).abs() < 1e-12), "{found:?}");
    }

    #[test]
    fn directions_share_a_half_duplex_link_only() {
        assert_eq!(ends(&tree(Duplex::Full), &[(0, 1, 1e9), (1, 0, 1e9)]), [1.0, 1.0]);
        assert_eq!(ends(&tree(Duplex::Half), &[(0, 1, 1e9), (1, 0, 1e9)]), [2.0, 2.0]);
    }

    #[test]
    fn flows_without_bytes_or_links_end_at_once() {
        assert_eq!(ends(&tree(Duplex::Full), &[(0, 1, 0.0), (2, 2, 5.0)]), [0.0, 0.0]);
    }
}
