//! Borrowed positions of the blocks of a rank's rows, without values. Copies and sweeps of the matrix use them.

/// Pattern of a rank's rows, in the layout of the matrix.
#[derive(Clone, Copy)]
pub struct RankPattern<'a> {
    /// Start of each own row; one more than rows.
    pub offsets: &'a [u32],
    /// Local columns, ascending in a row.
    pub columns: &'a [u32],
    /// See [`crate::assembly::SellLayout::block_address`].
    pub block_address: &'a [u32],
}
