//! The matrix that PCG multiplies by, with its rows spread over the ranks. `comparison` has other operators.

use super::pipelined::PipelinedSpmv;
use crate::assembly::{SellMatrix, SystemMatrix};
use crate::context::RankContext;
use crate::gpu::DeviceVec;
use crate::transport::TransportError;

/// A symmetric matrix that all ranks multiply together.
pub trait Operator {
    /// w = A u. `u`: a local vector with valid own rows; its halo rows are received during the product. `w`: own rows.
    fn apply(
        &mut self,
        rank: &mut RankContext<'_>,
        u: &mut DeviceVec<f32>,
        w: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError>;
}

/// The stored matrix of a step or of a file.
pub struct StoredMatrix<'a> {
    /// Computes the products.
    pub spmv: &'a mut PipelinedSpmv,
    /// Elastic and contact blocks.
    pub matrix: SystemMatrix<'a>,
}

impl Operator for StoredMatrix<'_> {
    fn apply(
        &mut self,
        rank: &mut RankContext<'_>,
        u: &mut DeviceVec<f32>,
        w: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        self.spmv.apply(rank, &self.matrix, u, w)
    }
}

impl StoredMatrix<'_> {
    /// w += (R + C) u for the contact blocks C and `rest` = R, the elastic blocks that w does not hold yet.
    pub(super) fn add_rest(
        &mut self,
        rank: &mut RankContext<'_>,
        rest: &SellMatrix,
        u: &mut DeviceVec<f32>,
        w: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        self.spmv.add(rank, &SystemMatrix { elastic: rest, contact: self.matrix.contact }, u, w)
    }
}
