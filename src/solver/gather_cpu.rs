//! CPU twin of `gather.wgsl`.

/// message[row of `rows`][vector] = the row's three values; own rows begin at row `first` of the vectors.
pub(super) fn gather(rows: &[u32], first: usize, vectors: &[&[f32]], message: &mut [f32]) {
    for (&row, message) in rows.iter().zip(message.chunks_exact_mut(3 * vectors.len())) {
        let at = (first + row as usize) * 3;
        for (vector, message) in vectors.iter().zip(message.chunks_exact_mut(3)) {
            message.copy_from_slice(&vector[at..at + 3]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::gather;

    #[test]
    fn rows_of_two_vectors_are_interleaved() {
        let a: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let b: Vec<f32> = a.iter().map(|v| v + 100.0).collect();
        let mut message = [0.0; 12];
        gather(&[0, 2], 1, &[&a, &b], &mut message);
        assert_eq!(message, [3.0, 4.0, 5.0, 103.0, 104.0, 105.0, 9.0, 10.0, 11.0, 109.0, 110.0, 111.0]);
    }
}
