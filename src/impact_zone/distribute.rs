//! Zones onto ranks: the largest first, each to the rank with least to do.

/// The rank of every zone, from the zones' sizes (any unit of work).
pub fn distribute(sizes: &[u64], ranks: usize) -> Vec<u32> {
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by_key(|&zone| (std::cmp::Reverse(sizes[zone]), zone));
    let mut loads = vec![0u64; ranks.max(1)];
    let mut owners = vec![0u32; sizes.len()];
    for zone in order {
        let rank = (0..loads.len()).min_by_key(|&rank| (loads[rank], rank)).unwrap_or(0);
        loads[rank] += sizes[zone];
        owners[zone] = rank as u32;
    }
    owners
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_zones_are_spread_first() {
        assert_eq!(distribute(&[1, 9, 4, 5, 1], 2), [0, 0, 1, 1, 1]);
        assert_eq!(distribute(&[3, 3, 3], 4), [0, 1, 2]);
        assert_eq!(distribute(&[7, 2], 1), [0, 0]);
        assert_eq!(distribute(&[], 3), [0u32; 0]);
    }
}
