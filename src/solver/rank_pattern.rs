//! Where the blocks of a rank's rows are, for whatever copies or sweeps them. Borrowed; knows no values.

/// Pattern of a rank's rows, as the matrix was laid out.
#[derive(Clone, Copy)]
pub struct RankPattern<'a> {
    /// Start of each own row; one more than rows.
    pub offsets: &'a [u32],
    /// Local columns, ascending in a row.
    pub columns: &'a [u32],
    /// See [`crate::assembly::SellLayout::block_address`].
    pub block_address: &'a [u32],
}
