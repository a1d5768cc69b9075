//! Product that receives all whole sub-vectors before it multiplies [Cevahir et al. 2009]. It measures the time that
//! the pipelined product of `full` mode saves. Both add the same terms in the same order, so they give the same bits.

use crate::assembly::SystemMatrix;
use crate::context::RankContext;
use crate::gpu::DeviceVec;
use crate::solver::operator::Operator;
use crate::solver::pipelined::PipelinedSpmv;
use crate::transport::TransportError;

/// A stored matrix, multiplied after all transfers.
pub struct GatherFirst<'a> {
    spmv: &'a mut PipelinedSpmv,
    matrix: SystemMatrix<'a>,
    gathered: Vec<Vec<f32>>,
}

impl<'a> GatherFirst<'a> {
    /// `spmv`: of `full` mode.
    pub fn new(spmv: &'a mut PipelinedSpmv, matrix: SystemMatrix<'a>) -> GatherFirst<'a> {
        let gathered = vec![Vec::new(); spmv.stages()];
        GatherFirst { spmv, matrix, gathered }
    }
}

impl Operator for GatherFirst<'_> {
    fn apply(
        &mut self,
        rank: &mut RankContext<'_>,
        u: &mut DeviceVec<f32>,
        w: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        self.spmv.publish_sub_vector(rank, self.matrix.elastic.rows, u)?;
        for (stage, v_j) in self.gathered.iter_mut().enumerate() {
            self.spmv.receive_sub_vector(rank, stage, v_j)?;
        }
        self.spmv.multiply_own_block(rank, &self.matrix, false, u, w);
        for (stage, v_j) in self.gathered.iter().enumerate() {
            self.spmv.add_block(rank, &self.matrix, stage, v_j, u, w);
        }
        Ok(())
    }
}
