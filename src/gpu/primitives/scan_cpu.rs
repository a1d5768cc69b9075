//! Native twin of `scan.wgsl`.

/// `sums[i]` becomes the sum of `values[..i]`; one thread, as memory is read and written once.
pub(super) fn exclusive_scan(values: &[u32], sums: &mut [u32]) {
    let mut before = 0u32;
    for i in 0..sums.len() {
        sums[i] = before;
        before = before.wrapping_add(values.get(i).copied().unwrap_or(0));
    }
}

#[cfg(test)]
mod tests {
    use super::exclusive_scan;

    #[test]
    fn sums_of_what_comes_before() {
        let mut sums = [9; 5];
        exclusive_scan(&[3, 0, 2, 7], &mut sums);
        assert_eq!(sums, [0, 3, 3, 5, 12]);
        exclusive_scan(&[3, 0, 2, 7, 1], &mut sums);
        assert_eq!(sums, [0, 3, 3, 5, 12]);
        exclusive_scan(&[], &mut sums[..1]);
        assert_eq!(sums[0], 0);
        exclusive_scan(&[], &mut []);
    }

    #[test]
    fn sums_wrap() {
        let mut sums = [0; 3];
        exclusive_scan(&[u32::MAX, 2], &mut sums);
        assert_eq!(sums, [0, u32::MAX, 1]);
    }
}
