//! Pipelined SpMV over all ranks [Li et al. 2020, Sec. 3.1]: transfers run in the order of the work queue while rows (or
//! blocks) that are ready are multiplied.
//!
//! `halo`: publish the rows others read; multiply rows without halo columns; receive; multiply the rest. Each row is summed
//! once, elastic blocks before contact blocks, each in global column order, so the bits do not depend on the number of ranks.
//! `full`: publish the whole sub-vector; multiply A_ii v_i; then per stage receive v_j and add A_ij v_j (Eq. 5). The order of
//! a row's sum is the order of the stages, so its bits depend on the rank count and the schedule.

use crate::assembly::SystemMatrix;
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

use super::exchange::{ExchangeMode, HaloExchange, TrafficCounter};
use super::spmv::Spmv;

/// y = A u over all ranks; holds what is fixed while the halo is.
pub struct PipelinedSpmv {
    kernel: Spmv,
    mode: ExchangeMode,
    halo: HaloExchange,
    queue: Vec<QueueNode>,
    sub_vector_len: usize,
    staging: Vec<f32>,
    /// True: products are added to y instead of overwriting it.
    pub accumulate: bool,
    /// Vector bytes received by products since the last reset.
    pub traffic: TrafficCounter,
}

impl PipelinedSpmv {
    /// `queue`: the own rank's work queue; `sub_vector_rows`: padded length of every sub-vector.
    pub fn new(
        executor: &Executor,
        mode: ExchangeMode,
        halo: HaloExchange,
        queue: Vec<QueueNode>,
        sub_vector_rows: usize,
    ) -> PipelinedSpmv {
        PipelinedSpmv {
            kernel: Spmv::new(executor),
            mode,
            halo,
            queue,
            sub_vector_len: sub_vector_rows * 3,
            staging: Vec::new(),
            accumulate: false,
            traffic: TrafficCounter::default(),
        }
    }

    /// Exchange of halo rows, also used for positions and velocities.
    pub fn halo(&mut self) -> &mut HaloExchange {
        &mut self.halo
    }

    /// First value of the own rows in a local vector.
    pub fn own_start(&self) -> usize {
        self.halo.plan().own.start * 3
    }

    /// Values of a local vector.
    pub fn local_len(&self) -> usize {
        self.halo.plan().local_rows * 3
    }

    /// y = A u. `u` is a local vector whose own rows are valid; its halo rows are filled on the way.
    pub fn apply(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        matrix: &SystemMatrix<'_>,
        u: &mut DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
        recorder: &mut Recorder,
    ) -> Result<(), TransportError> {
        match self.mode {
            ExchangeMode::Halo => self.apply_halo(executor, transport, matrix, u, y, recorder),
            ExchangeMode::Full => self.apply_full(executor, transport, matrix, u, y, recorder),
        }
    }

    fn apply_halo(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        matrix: &SystemMatrix<'_>,
        u: &mut DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
        recorder: &mut Recorder,
    ) -> Result<(), TransportError> {
        self.halo.publish(executor, transport, &[&*u], recorder)?;
        let start = recorder.before_kernels();
        self.multiply(executor, matrix, 0, u, y);
        // A device works on these rows while the halo is received.
        executor.flush();
        recorder.end(EventName::SpmvLocal, Activity::Compute, start, matrix.section_bytes(0), matrix.section_flops(0));
        self.halo.receive(executor, transport, &mut [u], recorder, &mut self.traffic)?;
        let start = recorder.before_kernels();
        self.multiply(executor, matrix, 1, u, y);
        recorder.end(EventName::SpmvRemote, Activity::Compute, start, matrix.section_bytes(1), matrix.section_flops(1));
        Ok(())
    }

    /// Rows of section `section`: the elastic sum first, then what contacts add. No row is in an earlier section of the
    /// contact matrix than of the elastic one.
    fn multiply(
        &self,
        executor: &Executor,
        matrix: &SystemMatrix<'_>,
        section: usize,
        u: &DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) {
        self.kernel.apply(executor, matrix.elastic, section, self.accumulate, u, y);
        if let Some(contact) = matrix.contact {
            self.kernel.apply(executor, contact, section, true, u, y);
        }
    }

    fn apply_full(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        matrix: &SystemMatrix<'_>,
        u: &DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
        recorder: &mut Recorder,
    ) -> Result<(), TransportError> {
        let rank = transport.rank();
        let own = self.own_start()..self.own_start() + matrix.elastic.rows * 3;
        let start = recorder.now();
        self.staging.resize(self.sub_vector_len, 0.0);
        u.read_range(executor, own.start, &mut self.staging[..own.len()]);
        if transport.ranks() > 1 {
            let own_sub_vector = &self.staging;
            transport.publish(self.sub_vector_len, &mut |out| out.copy_from_slice(own_sub_vector))?;
            recorder.end(EventName::Publish, Activity::Transfer, start, self.sub_vector_len as u64 * 4, 0);
        }
        let block = (0, rank as u32, rank as u32);
        let start = recorder.before_kernels();
        self.kernel.apply_host(executor, matrix.elastic, 0, self.accumulate, &self.staging, y);
        if let Some(contact) = matrix.contact {
            self.kernel.apply_host(executor, contact, 0, true, &self.staging, y);
        }
        recorder.end_transfer(
            EventName::SpmvBlock,
            Activity::Compute,
            start,
            block,
            matrix.section_bytes(0),
            matrix.section_flops(0),
        );
        for stage in 0..self.queue.len() {
            let node = self.queue[stage];
            let route = (stage as u32 + 1, node.source as u32, node.vector as u32);
            if !transport.ready(node.vector) {
                let start = recorder.now();
                transport.wait(node.vector)?;
                recorder.end_transfer(EventName::Receive, Activity::Wait, start, route, 0, 0);
            }
            let (kernel, section, len) = (&self.kernel, stage + 1, self.sub_vector_len);
            let (mut got, start) = (0, recorder.now());
            transport.receive(node.vector, &mut |v_j| {
                got = v_j.len();
                if got == len {
                    recorder.end_transfer(EventName::Receive, Activity::Transfer, start, route, got as u64 * 4, 0);
                    let start = recorder.before_kernels();
                    for part in matrix.parts() {
                        kernel.apply_host(executor, part, section, true, v_j, y);
                    }
                    recorder.end_transfer(
                        EventName::SpmvBlock,
                        Activity::Compute,
                        start,
                        route,
                        matrix.section_bytes(section),
                        matrix.section_flops(section),
                    );
                }
            })?;
            if got != len {
                return Err(TransportError::Mechanism {
                    rank,
                    message: format!("sub-vector {} holds {got} values instead of {len}", node.vector),
                });
            }
            self.traffic.received_bytes += len as u64 * 4;
            self.traffic.messages += 1;
        }
        Ok(())
    }
}
