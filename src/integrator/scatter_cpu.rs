//! CPU twin of `scatter.wgsl`.

/// out[row] = values[i] for the i-th row of `rows`.
pub(super) fn scatter(rows: &[u32], values: &[[f32; 3]], first: usize, out: &mut [f32]) {
    for (&row, value) in rows.iter().zip(values) {
        out[first + row as usize * 3..][..3].copy_from_slice(value);
    }
}
