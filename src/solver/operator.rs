//! What PCG multiplies: the matrix of a system whose rows are spread over the ranks. The room of the comparison methods
//! (`comparison`) holds other operators.

use super::pipelined::PipelinedSpmv;
use crate::assembly::{SellMatrix, SystemMatrix};
use crate::context::RankContext;
use crate::gpu::DeviceVec;
use crate::transport::TransportError;

/// A symmetric matrix, multiplied by all ranks together.
pub trait Operator {
    /// w = A u. `u`: a local vector whose own rows are valid; its halo rows are received on the way. `w`: own rows.
    fn apply(
        &mut self,
        rank: &mut RankContext<'_>,
        u: &mut DeviceVec<f32>,
        w: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError>;
}

/// The stored matrix of a step or of a file.
pub struct StoredMatrix<'a> {
    /// Multiplies it.
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
