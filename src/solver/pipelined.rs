//! Pipelined SpMV over all ranks [Li et al. 2020, Sec. 3.1]: transfers run in the order of the work queue while rows (or
//! blocks) that are ready are multiplied.
//!
//! `halo`: publish the rows others read; multiply rows without halo columns; receive; multiply the rest. Each row is summed
//! once, elastic blocks before contact blocks, each in global column order, so the bits do not depend on the number of ranks.
//! `full`: publish the whole sub-vector; multiply A_ii v_i; then per stage receive v_j and add A_ij v_j (Eq. 5). The order of
//! a row's sum is the order of the stages, so its bits depend on the rank count and the schedule.

use crate::assembly::{ElementMatrix, SystemMatrix};
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Transport, TransportError};

use super::exchange::{ExchangeMode, HaloExchange, TrafficCounter};
use super::matrix_free::MatrixFree;
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
    /// True: `full` waits for all sub-vectors before it multiplies [Cevahir et al. 2009], the baseline that benchmarks show.
    pub gather_first: bool,
    gathered: Vec<Vec<f32>>,
    matrix_free: MatrixFree,
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
            gather_first: false,
            gathered: Vec::new(),
            matrix_free: MatrixFree::default(),
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
        if let Some(elements) = &matrix.elements {
            return self.apply_elements(executor, transport, elements, u, y, recorder);
        }
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

    /// Without a stored matrix: all elements need all halo rows, so nothing overlaps.
    fn apply_elements(
        &mut self,
        executor: &Executor,
        transport: &mut dyn Transport,
        elements: &ElementMatrix<'_>,
        u: &mut DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
        recorder: &mut Recorder,
    ) -> Result<(), TransportError> {
        self.halo.publish(executor, transport, &[&*u], recorder)?;
        self.halo.receive(executor, transport, &mut [u], recorder, &mut self.traffic)?;
        let start = recorder.now();
        let (own_start, local_rows) = (self.halo.plan().own.start, self.halo.plan().local_rows);
        self.matrix_free.apply(executor, elements, self.accumulate, own_start, local_rows, u, y);
        let (bytes, flops) = (elements.product_bytes(), elements.product_flops());
        recorder.end(EventName::SpmvRemote, Activity::Compute, start, bytes, flops);
        Ok(())
    }

    /// Bytes that products keep beside matrix and vectors.
    pub fn scratch_bytes(&self) -> u64 {
        self.matrix_free.bytes()
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
        if self.gather_first {
            self.gather_all(transport, recorder)?;
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
            let (kernel, section, len) = (&self.kernel, stage + 1, self.sub_vector_len);
            let route = route(stage, self.queue[stage]);
            let mut multiply = |recorder: &mut Recorder, v_j: &[f32]| {
                let start = recorder.before_kernels();
                for part in matrix.parts() {
                    kernel.apply_host(executor, part, section, true, v_j, y);
                }
                let (bytes, flops) = (matrix.section_bytes(section), matrix.section_flops(section));
                recorder.end_transfer(EventName::SpmvBlock, Activity::Compute, start, route, bytes, flops);
            };
            match self.gather_first {
                true => multiply(recorder, &self.gathered[stage]),
                false => receive_whole(transport, route, len, &mut self.traffic, recorder, multiply)?,
            }
        }
        Ok(())
    }

    /// Copies all sub-vectors, in the order of the work queue.
    fn gather_all(&mut self, transport: &mut dyn Transport, recorder: &mut Recorder) -> Result<(), TransportError> {
        self.gathered.resize(self.queue.len(), Vec::new());
        for (stage, gathered) in self.gathered.iter_mut().enumerate() {
            let (route, len) = (route(stage, self.queue[stage]), self.sub_vector_len);
            receive_whole(transport, route, len, &mut self.traffic, recorder, |_, v_j| {
                gathered.clear();
                gathered.extend_from_slice(v_j);
            })?;
        }
        Ok(())
    }
}

/// (stage from 1, source, sub-vector) of an event.
fn route(stage: usize, node: QueueNode) -> (u32, u32, u32) {
    (stage as u32 + 1, node.source as u32, node.vector as u32)
}

/// Receives the sub-vector that `route` names, of `len` values, and hands it to `take`.
fn receive_whole(
    transport: &mut dyn Transport,
    route: (u32, u32, u32),
    len: usize,
    traffic: &mut TrafficCounter,
    recorder: &mut Recorder,
    mut take: impl FnMut(&mut Recorder, &[f32]),
) -> Result<(), TransportError> {
    let vector = route.2 as usize;
    if !transport.ready(vector) {
        let start = recorder.now();
        transport.wait(vector)?;
        recorder.end_transfer(EventName::Receive, Activity::Wait, start, route, 0, 0);
    }
    let (mut got, start) = (0, recorder.now());
    transport.receive(vector, &mut |v_j| {
        got = v_j.len();
        if got == len {
            recorder.end_transfer(EventName::Receive, Activity::Transfer, start, route, got as u64 * 4, 0);
            take(recorder, v_j);
        }
    })?;
    if got != len {
        let message = format!("sub-vector {vector} holds {got} values instead of {len}");
        return Err(TransportError::Mechanism { rank: transport.rank(), message });
    }
    traffic.received_bytes += len as u64 * 4;
    traffic.messages += 1;
    Ok(())
}
