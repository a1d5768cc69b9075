//! A symmetric matrix of 3x3 blocks in compressed rows. Both triangles are stored, with values in the precision of the
//! file.

use crate::assembly::sell::BLOCK;
use crate::math::DIM;

/// Values of all blocks, block after block, row-major inside a block.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Single precision, as stored in the file.
    F32(Vec<f32>),
    /// Double precision.
    F64(Vec<f64>),
}

impl Default for Values {
    fn default() -> Self {
        Values::F32(Vec::new())
    }
}

impl Values {
    /// Number of values.
    pub fn len(&self) -> usize {
        match self {
            Values::F32(values) => values.len(),
            Values::F64(values) => values.len(),
        }
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Value `index` in double precision.
    #[inline(always)]
    pub fn get(&self, index: usize) -> f64 {
        match self {
            Values::F32(values) => values[index] as f64,
            Values::F64(values) => values[index],
        }
    }

    /// Copies a range of values.
    pub fn part(&self, range: std::ops::Range<usize>) -> Values {
        match self {
            Values::F32(values) => Values::F32(values[range].to_vec()),
            Values::F64(values) => Values::F64(values[range].to_vec()),
        }
    }
}

/// The matrix of a system. Only the readers construct it, after these checks: columns ascending in a row, every value
/// finite, symmetric, positive diagonal.
#[derive(Clone, Debug, PartialEq)]
pub struct BlockSystem {
    /// Rows of the matrix in the file. Further rows in the last block row are padding.
    pub scalar_rows: usize,
    /// Start of each block row in `columns`; one entry more than block rows.
    pub offsets: Vec<u32>,
    /// Block column of each block.
    pub columns: Vec<u32>,
    /// Nine values per block.
    pub values: Values,
    /// Largest diagonal value of the rows of the file.
    pub(super) largest_diagonal: f64,
}

impl BlockSystem {
    /// Number of block rows.
    pub fn block_rows(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Number of stored blocks.
    pub fn blocks(&self) -> usize {
        self.columns.len()
    }

    /// The product of A and the vector of ones, in double precision: a right-hand side whose solution is 1 everywhere.
    /// One value per row of the file.
    pub fn times_ones(&self) -> Vec<f64> {
        let mut sums = vec![0.0; self.block_rows() * DIM];
        for row in 0..self.block_rows() {
            for k in self.offsets[row] as usize..self.offsets[row + 1] as usize {
                for c in 0..BLOCK {
                    sums[row * DIM + c / DIM] += self.values.get(k * BLOCK + c);
                }
            }
        }
        sums.truncate(self.scalar_rows);
        sums
    }
}
