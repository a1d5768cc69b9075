//! The part of a linear system that one rank owns: its rows, halo and right-hand side. The coordinator builds it and
//! sends it to the worker as a small header and flat arrays.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::system::{BlockSystem, Values};
use crate::assembly::sell::BLOCK;
use crate::math::DIM;
use crate::partition::{HaloPlan, RowPartition, halo_plans};

/// All data that a worker needs to solve for its rows. Columns are local indices of `plan`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RankSystem {
    /// Distribution of the rows over the ranks.
    pub partition: RowPartition,
    /// Halo of this rank.
    pub plan: HaloPlan,
    /// Power of two near the largest diagonal value. The solve divides the matrix by it, so that values in any unit fit
    /// f32.
    pub matrix_scale: f64,
    /// Power of two near the largest value of the right-hand side. The solve divides the right-hand side by it.
    pub rhs_scale: f64,
    /// True if the values of the matrix are f64.
    pub double_precision: bool,
    /// The bulk arrays. They are sent separately from the serialized header.
    #[serde(skip)]
    pub arrays: RankSystemArrays,
}

/// Flat arrays of a [`RankSystem`], in the units of the file.
#[derive(Clone, Debug, Default)]
pub struct RankSystemArrays {
    /// Start of each own row in `columns`; one entry more than own rows.
    pub offsets: Vec<u32>,
    /// Local column of each block, ascending in a row.
    pub columns: Vec<u32>,
    /// Nine values per block.
    pub values: Values,
    /// Three values per own row.
    pub rhs: Vec<f64>,
}

/// Why bytes cannot be decoded into the arrays of a system.
#[derive(Debug, Error)]
pub enum RankSystemError {
    /// Wrong number of arrays or an array of the wrong length.
    #[error("system of a rank: {0}")]
    Arrays(String),
}

impl BlockSystem {
    /// Splits the system with right-hand side `rhs` (one value per row of the file) over the ranks of `partition`.
    /// `emit` receives the parts in rank order, one at a time. With a single rank, the arrays are moved, not copied.
    ///
    /// # Errors
    /// The errors of `emit`.
    pub fn split<E>(
        mut self,
        mut rhs: Vec<f64>,
        partition: &RowPartition,
        mut emit: impl FnMut(usize, RankSystem) -> Result<(), E>,
    ) -> Result<(), E> {
        assert_eq!((rhs.len(), self.block_rows()), (self.scalar_rows, partition.rows()));
        let matrix_scale = power_of_two(self.largest_diagonal);
        let rhs_scale = power_of_two(rhs.iter().fold(0.0, |largest: f64, v| largest.max(v.abs())));
        rhs.resize(self.block_rows() * DIM, 0.0);
        let double_precision = matches!(self.values, Values::F64(_));
        let halos = (0..partition.ranks()).map(|rank| self.halo_of(partition.rows_of(rank))).collect::<Vec<_>>();
        for (rank, plan) in halo_plans(partition, &halos).into_iter().enumerate() {
            let arrays = match partition.ranks() {
                1 => RankSystemArrays {
                    offsets: std::mem::take(&mut self.offsets),
                    columns: std::mem::take(&mut self.columns),
                    values: std::mem::take(&mut self.values),
                    rhs: std::mem::take(&mut rhs),
                },
                _ => self.part(&rhs, partition.rows_of(rank), &plan),
            };
            emit(rank, RankSystem { partition: *partition, plan, matrix_scale, rhs_scale, double_precision, arrays })?;
        }
        Ok(())
    }

    /// Columns outside the own rows that the own rows read, ascending.
    fn halo_of(&self, rows: std::ops::Range<usize>) -> Vec<u32> {
        let blocks = self.offsets[rows.start] as usize..self.offsets[rows.end] as usize;
        let outside = |c: &u32| !rows.contains(&(*c as usize));
        let mut halo: Vec<u32> = self.columns[blocks].iter().copied().filter(outside).collect();
        halo.sort_unstable();
        halo.dedup();
        halo
    }

    fn part(&self, rhs: &[f64], rows: std::ops::Range<usize>, plan: &HaloPlan) -> RankSystemArrays {
        let first = self.offsets[rows.start];
        let blocks = first as usize..self.offsets[rows.end] as usize;
        let local = |&c: &u32| {
            let own = (c as usize).wrapping_sub(rows.start);
            if own < rows.len() {
                (plan.own.start + own) as u32
            } else {
                plan.local_from_global(c).expect("the halo was collected from these columns")
            }
        };
        RankSystemArrays {
            offsets: self.offsets[rows.start..=rows.end].iter().map(|&o| o - first).collect(),
            columns: self.columns[blocks.clone()].iter().map(local).collect(),
            values: self.values.part(blocks.start * BLOCK..blocks.end * BLOCK),
            rhs: rhs[rows.start * DIM..rows.end * DIM].to_vec(),
        }
    }
}

/// The largest power of two that is at most `value`; 1 for 0. Division by it is exact.
pub(super) fn power_of_two(value: f64) -> f64 {
    if value <= 0.0 {
        return 1.0;
    }
    // The range is limited to normal numbers, so that the reciprocal is normal too.
    let exponent = value.log2().floor().clamp(-1000.0, 1000.0);
    exponent.exp2()
}

impl RankSystemArrays {
    /// The arrays as bytes, in the order offsets, columns, values, right-hand side.
    pub fn to_bytes(&self) -> [&[u8]; 4] {
        let values = match &self.values {
            Values::F32(values) => bytemuck::cast_slice(values),
            Values::F64(values) => bytemuck::cast_slice(values),
        };
        [
            bytemuck::cast_slice(&self.offsets),
            bytemuck::cast_slice(&self.columns),
            values,
            bytemuck::cast_slice(&self.rhs),
        ]
    }

    /// Decodes bytes in the order of [`RankSystemArrays::to_bytes`]. The header gives `double_precision`.
    ///
    /// # Errors
    /// The number of arrays is wrong, or their lengths do not match.
    pub fn from_bytes(bytes: &[&[u8]], double_precision: bool) -> Result<RankSystemArrays, RankSystemError> {
        let [offsets, columns, values, rhs] = bytes else {
            return Err(RankSystemError::Arrays(format!("{} arrays instead of 4", bytes.len())));
        };
        let values = match double_precision {
            true => Values::F64(cast(values)?),
            false => Values::F32(cast(values)?),
        };
        let arrays = RankSystemArrays { offsets: cast(offsets)?, columns: cast(columns)?, values, rhs: cast(rhs)? };
        let blocks = arrays.columns.len();
        let ascending = arrays.offsets.is_sorted() && arrays.offsets.first() == Some(&0);
        let fits = ascending
            && arrays.offsets.last().map(|&end| end as usize) == Some(blocks)
            && arrays.values.len() == blocks * BLOCK
            && arrays.rhs.len() == (arrays.offsets.len() - 1) * DIM;
        match fits {
            true => Ok(arrays),
            false => Err(RankSystemError::Arrays("the lengths of the arrays do not fit each other".into())),
        }
    }
}

impl RankSystem {
    /// Number of values of the longest message that this rank publishes in either exchange mode.
    pub fn message_values(&self) -> usize {
        // A solution in double precision takes two f32 per value.
        (self.plan.publish_rows.len() * DIM * 2).max(self.partition.sub_vector_rows() * DIM)
    }
}

fn cast<T: bytemuck::Pod>(bytes: &[u8]) -> Result<Vec<T>, RankSystemError> {
    if !bytes.len().is_multiple_of(size_of::<T>()) {
        let (bytes, item) = (bytes.len(), size_of::<T>());
        return Err(RankSystemError::Arrays(format!("{bytes} bytes are not a whole number of {item}-byte items")));
    }
    let mut out = vec![T::zeroed(); bytes.len() / size_of::<T>()];
    bytemuck::cast_slice_mut(&mut out).copy_from_slice(bytes);
    Ok(out)
}
