//! Routes for many multicasts at once: every item gets a tree of transfers from its owner to its readers, so that the
//! busiest link of the machine is as idle as possible. Links have prices that grow with their load; items are routed over
//! the cheapest trees one after the other and then again and again, as in multiplicative-weight packings of trees.

use super::network::Channels;

/// Something that one rank owns and others read. Readers hand it on to each other.
#[derive(Clone, Debug, PartialEq)]
pub struct Demand {
    /// Rank that has it.
    pub owner: usize,
    /// Size, bytes.
    pub bytes: f64,
    /// Ranks that need it, ascending, without the owner.
    pub readers: Vec<usize>,
}

/// The tree of an item: (source, receiver), a source always before those that it serves.
pub(super) type Tree = Vec<(usize, usize)>;

/// Rounds of rerouting, and how steeply prices rise with load in each.
const STEEPNESS: [f64; 7] = [4.0, 8.0, 16.0, 32.0, 48.0, 64.0, 96.0];

/// Loads of channels in seconds, and their prices in a round.
struct Prices<'a> {
    channels: &'a Channels,
    load_s: Vec<f64>,
    price: Vec<f64>,
    steepness: f64,
    target_s: f64,
}

impl Prices<'_> {
    fn reprice(&mut self, channel: usize) {
        let excess = (self.load_s[channel] / self.target_s - 1.0) * self.steepness;
        // Cut off where one link alone decides anyway.
        self.price[channel] = excess.min(600.0).exp() / self.channels.capacity[channel];
    }

    fn add(&mut self, tree: &Tree, bytes: f64) {
        let channels = self.channels;
        for &(source, receiver) in tree {
            for &channel in channels.path(source, receiver) {
                let channel = channel as usize;
                self.load_s[channel] += bytes / channels.capacity[channel];
                self.reprice(channel);
            }
        }
    }

    fn cost(&self, from: usize, to: usize) -> f64 {
        self.channels.path(from, to).iter().map(|channel| self.price[*channel as usize]).sum()
    }

    fn busiest_s(&self) -> f64 {
        self.load_s.iter().copied().fold(0.0, f64::max)
    }
}

/// Trees for `items`; `target_s` = about the load that the busiest link will have. The best round is kept.
pub(super) fn pack(channels: &Channels, items: &[Demand], target_s: f64, gpus: usize) -> Vec<Tree> {
    let count = channels.capacity.len();
    let mut prices =
        Prices { channels, load_s: vec![0.0; count], price: vec![0.0; count], steepness: STEEPNESS[0], target_s };
    let mut trees: Vec<Tree> = vec![Tree::new(); items.len()];
    let mut best: Option<(f64, Vec<Tree>)> = None;
    for steepness in STEEPNESS {
        prices.steepness = steepness;
        (0..count).for_each(|channel| prices.reprice(channel));
        for (item, tree) in items.iter().zip(&mut trees) {
            prices.add(tree, -item.bytes);
            *tree = cheapest_tree(&prices, item, gpus);
            prices.add(tree, item.bytes);
        }
        let busiest_s = prices.busiest_s();
        if best.as_ref().is_none_or(|(least_s, _)| busiest_s < least_s * (1.0 - 1e-9)) {
            best = Some((busiest_s, trees.clone()));
        }
        if busiest_s <= target_s * (1.0 + 1e-9) {
            break;
        }
    }
    best.map_or(trees, |(_, trees)| trees)
}

/// Grows a tree from the owner: always the reader that is cheapest to reach next; among equals the one that is nearest to
/// the owner in hops, then the lowest rank.
fn cheapest_tree(prices: &Prices<'_>, item: &Demand, gpus: usize) -> Tree {
    let mut depth = vec![0u32; gpus];
    let mut open: Vec<(usize, f64, usize)> =
        item.readers.iter().map(|&reader| (reader, prices.cost(item.owner, reader), item.owner)).collect();
    let mut tree = Tree::with_capacity(open.len());
    while !open.is_empty() {
        let key = |&(reader, cost, source): &(usize, f64, usize)| (cost, depth[source], reader);
        let mut next = 0;
        for i in 1..open.len() {
            let ((cost, hops, reader), (least, fewest, lowest)) = (key(&open[i]), key(&open[next]));
            let cheaper = cost < least * (1.0 - 1e-12);
            if cheaper || (cost <= least * (1.0 + 1e-12) && (hops, reader) < (fewest, lowest)) {
                next = i;
            }
        }
        let (reader, _, source) = open.swap_remove(next);
        depth[reader] = depth[source] + 1;
        tree.push((source, reader));
        for (other, cost, from) in &mut open {
            let through = prices.cost(reader, *other);
            if through < *cost * (1.0 - 1e-12) {
                (*cost, *from) = (through, reader);
            }
        }
    }
    tree
}
