//! Bytes of a recorded step between hosts, as the transport between machines sends them: rows that are read go to each
//! of their readers, and what all ranks get crosses to every other host once. Modeled: the heads of messages and
//! packets are those of TCP over Ethernet.

use super::recorded::{Phase, RecordedStep, Traffic};
use super::replay::ProductExchange;

/// Bytes that MPI puts before a message.
const MESSAGE_HEAD: f64 = 40.0;
/// Bytes of a TCP segment in an Ethernet frame of 1500 bytes, with time stamps.
const SEGMENT: f64 = 1448.0;
/// Heads of a segment: Ethernet 14, IP 20, TCP with time stamps 32.
const SEGMENT_HEAD: f64 = 66.0;
/// Bytes of a count that ranks tell each other.
const COUNT: f64 = 16.0;

/// What crosses between hosts, all directions together.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Crossing {
    /// Messages.
    pub messages: f64,
    /// Bytes of their contents.
    pub payload_bytes: f64,
    /// Bytes of the packets, those that acknowledge included.
    pub wire_bytes: f64,
}

impl Crossing {
    /// Adds `times` messages of `bytes` each.
    fn add(&mut self, times: f64, bytes: f64) {
        let framed = bytes + MESSAGE_HEAD;
        let segments = (framed / SEGMENT).ceil();
        // Every second segment is acknowledged, and the last one of a message.
        let acknowledgments = (segments / 2.0).ceil();
        self.messages += times;
        self.payload_bytes += times * bytes;
        self.wire_bytes += times * (framed + SEGMENT_HEAD * (segments + acknowledgments));
    }

    /// Both together.
    pub fn plus(self, other: Crossing) -> Crossing {
        Crossing {
            messages: self.messages + other.messages,
            payload_bytes: self.payload_bytes + other.payload_bytes,
            wire_bytes: self.wire_bytes + other.wire_bytes,
        }
    }

    /// The mean of `count`; nothing of none.
    pub fn over(self, count: usize) -> Crossing {
        let count = count.max(1) as f64;
        Crossing {
            messages: self.messages / count,
            payload_bytes: self.payload_bytes / count,
            wire_bytes: self.wire_bytes / count,
        }
    }

    fn add_traffic(&mut self, traffic: &Traffic, hosts: &[usize], whole: bool) {
        for (owner, row) in traffic.received.iter().enumerate() {
            let crossing = row.iter().zip(hosts).filter(|(_, host)| **host != hosts[owner]);
            for (&bytes, _) in crossing {
                let bytes = if whole { traffic.published[owner] } else { bytes };
                if bytes > 0.0 {
                    self.add(1.0, bytes);
                }
            }
        }
    }
}

/// What the hosts send each other in a step, and in its matrix-vector products alone, whose number is returned, too.
/// `hosts`: by rank, a number of its host.
pub fn crossing(step: &RecordedStep, hosts: &[usize], exchange: ProductExchange) -> (Crossing, Crossing, usize) {
    let mut numbers = hosts.to_vec();
    numbers.sort_unstable();
    numbers.dedup();
    let others = numbers.len().saturating_sub(1) as f64;
    let (mut all, mut products, mut count) = (Crossing::default(), Crossing::default(), 0);
    for phase in &step.phases {
        match phase {
            Phase::Kernels(..) => {}
            Phase::Exchange(traffic) => all.add_traffic(traffic, hosts, false),
            Phase::Product(traffic, _) => {
                products.add_traffic(traffic, hosts, exchange != ProductExchange::Halo);
                count += 1;
            }
            Phase::AllReduce(bytes) => bytes.iter().for_each(|&bytes| all.add(others, bytes)),
            Phase::Share(bytes) => bytes.iter().filter(|bytes| **bytes > 0.0).for_each(|&bytes| all.add(others, bytes)),
            Phase::ShareCounts => hosts.iter().for_each(|_| all.add(others, COUNT)),
        }
    }
    (all.plus(products), products, count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::interconnect::{Kernel, RecordedProduct};

    #[test]
    fn rows_go_to_their_readers_and_whole_lists_to_hosts() {
        // Ranks 0 and 1 on one host, 2 on another.
        let hosts = [5, 5, 2];
        let received = vec![vec![0.0, 24.0, 36.0], vec![12.0, 0.0, 0.0], vec![0.0, 1408.0, 0.0]];
        let traffic = Traffic { published: vec![48.0, 12.0, 1408.0], received };
        let halo = RecordedProduct::Halo(vec![(Kernel::default(), Kernel::default()); 3]);
        let phases =
            vec![Phase::Product(traffic, halo), Phase::Share(vec![100.0, 0.0, 200.0]), Phase::AllReduce(vec![24.0; 3])];
        let step = RecordedStep { step: 1, phases };
        let (all, products, count) = crossing(&step, &hosts, ProductExchange::Halo);
        assert_eq!((count, products.messages, products.payload_bytes), (1, 2.0, 36.0 + 1408.0));
        // Both messages fit a segment each; each is acknowledged.
        assert_eq!(products.wire_bytes, 36.0 + 1408.0 + 2.0 * (40.0 + 2.0 * 66.0));
        assert_eq!((all.messages, all.payload_bytes), (2.0 + 2.0 + 3.0, 36.0 + 1408.0 + 300.0 + 72.0));
        let (_, full, _) = crossing(&step, &hosts, ProductExchange::Full);
        // From 0 and from 1 to 2, and from 2 to both.
        assert_eq!(full.payload_bytes, 48.0 + 12.0 + 2.0 * 1408.0);
        let (alone, ..) = crossing(&step, &[1; 3], ProductExchange::Halo);
        assert_eq!((alone.payload_bytes, alone.wire_bytes), (0.0, 0.0));
    }

    #[test]
    fn long_messages_are_cut_into_segments() {
        let mut long = Crossing::default();
        long.add(1.0, 14_480.0);
        assert_eq!(long.wire_bytes, 14_480.0 + 40.0 + 66.0 * (11.0 + 6.0));
    }
}
