//! Pipelined SpMV over all ranks [Li et al. 2020, Sec. 3.1]: transfers run in the order of the work queue while rows (or
//! blocks) that are ready are multiplied.
//!
//! `halo`: publish the rows others read; multiply rows without halo columns; receive; multiply the rest. Each row is summed
//! once, elastic blocks before contact blocks, each in global column order, so the bits do not depend on the number of ranks.
//! `full`: publish the whole sub-vector; multiply A_ii v_i; then per stage receive v_j and add A_ij v_j (Eq. 5). The order of
//! a row's sum is the order of the stages, so its bits depend on the rank count and the schedule.

use std::ops::Range;

use crate::assembly::SystemMatrix;
use crate::context::RankContext;
use crate::gpu::{DeviceVec, Executor};
use crate::interconnect::QueueNode;
use crate::math::DIM;
use crate::telemetry::{Activity, EventName, Recorder};
use crate::transport::{Pattern, Transport, TransportError};

use super::exchange::{ExchangeMode, HaloExchange, TrafficCounter};
use super::spmv::{NO_DIAGONAL, OwnRows, Spmv};

/// y = A u over all ranks, with the data that stays fixed between changes of the halo.
pub struct PipelinedSpmv {
    kernel: Spmv,
    mode: ExchangeMode,
    halo: HaloExchange,
    queue: Vec<QueueNode>,
    sub_vector_len: usize,
    /// Pattern in which every rank reads every sub-vector; made with the first product in mode `full`.
    whole: Option<Pattern>,
    /// Own sub-vector, padded.
    staging: Vec<f32>,
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
            sub_vector_len: sub_vector_rows * DIM,
            whole: None,
            staging: Vec::new(),
            traffic: TrafficCounter::default(),
        }
    }

    /// Exchange of halo rows; positions and velocities use it, too.
    pub fn halo(&mut self) -> &mut HaloExchange {
        &mut self.halo
    }

    /// Exchange mode of the products.
    pub fn mode(&self) -> ExchangeMode {
        self.mode
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
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        u: &mut DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        self.multiply(rank, matrix, false, u, y)
    }

    /// y += A u; otherwise as [`PipelinedSpmv::apply`].
    pub fn add(
        &mut self,
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        u: &mut DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        self.multiply(rank, matrix, true, u, y)
    }

    /// Receives the halo rows of `u` without overlapping any product; returns the own rows and the number of local
    /// rows.
    pub(super) fn exchange_halo(
        &mut self,
        rank: &mut RankContext<'_>,
        u: &mut DeviceVec<f32>,
    ) -> Result<(Range<usize>, usize), TransportError> {
        self.halo.start(rank.executor, rank.transport, &[&*u], rank.recorder)?;
        self.halo.finish(rank.executor, rank.transport, &mut [u], rank.recorder, &mut self.traffic)?;
        Ok((self.halo.plan().own.clone(), self.halo.plan().local_rows))
    }

    fn multiply(
        &mut self,
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        accumulate: bool,
        u: &mut DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        match self.mode {
            ExchangeMode::Halo => self.multiply_halo(rank, matrix, accumulate, u, y),
            ExchangeMode::Full => self.multiply_full(rank, matrix, accumulate, u, y),
        }
    }

    fn multiply_halo(
        &mut self,
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        accumulate: bool,
        u: &mut DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        self.halo.start(rank.executor, rank.transport, &[&*u], rank.recorder)?;
        self.multiply_rows(rank, matrix, 0, accumulate, u, y);
        self.halo.finish(rank.executor, rank.transport, &mut [u], rank.recorder, &mut self.traffic)?;
        self.multiply_rows(rank, matrix, 1, accumulate, u, y);
        Ok(())
    }

    /// Multiplies the rows of section 0 (without halo columns) or 1: first the elastic sum, then the terms of contacts.
    /// A row's section in the contact matrix is never earlier than in the elastic matrix.
    fn multiply_rows(
        &self,
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        section: usize,
        accumulate: bool,
        u: &DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) {
        let start = rank.recorder.before_kernels();
        let own_start = self.halo.plan().own.start;
        self.kernel.apply(rank.executor, matrix.elastic, section, accumulate, u, own_start, y);
        if let Some(contact) = matrix.contact {
            self.kernel.apply(rank.executor, contact, section, true, u, own_start, y);
        }
        let name = match section {
            0 => {
                // A device works on these rows while the halo is received.
                rank.executor.flush();
                EventName::SpmvLocal
            }
            _ => EventName::SpmvRemote,
        };
        let (bytes, flops) = (matrix.section_bytes(section), matrix.section_flops(section));
        rank.recorder.end(name, Activity::Compute, start, bytes, flops);
    }

    fn multiply_full(
        &mut self,
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        accumulate: bool,
        u: &DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        self.publish_sub_vector(rank, matrix.elastic.rows, u)?;
        self.multiply_own_block(rank, matrix, accumulate, u, y);
        let own = OwnRows { x: u, start: self.halo.plan().own.start, diagonal: NO_DIAGONAL };
        for stage in 0..self.queue.len() {
            let (kernel, route, executor) = (&self.kernel, self.route(stage), rank.executor);
            receive_whole(rank.transport, route, &mut self.traffic, rank.recorder, |recorder, v_j| {
                multiply_block(kernel, executor, recorder, matrix, route, v_j, own, y);
            })?;
        }
        Ok(())
    }

    /// Publishes the own sub-vector: the `rows` own rows of `u`, padded.
    pub(super) fn publish_sub_vector(
        &mut self,
        rank: &mut RankContext<'_>,
        rows: usize,
        u: &DeviceVec<f32>,
    ) -> Result<(), TransportError> {
        let start = rank.recorder.now();
        self.staging.resize(self.sub_vector_len, 0.0);
        u.read_range(rank.executor, self.own_start(), &mut self.staging[..rows * 3]);
        if rank.transport.ranks() > 1 {
            let own_sub_vector = &self.staging;
            let whole = self.whole.get_or_insert_with(|| {
                let rows = vec![own_sub_vector.len() / DIM; rank.transport.ranks()];
                Pattern::whole(rank.transport.rank(), &rows)
            });
            rank.transport.start(whole, DIM, &mut |out| out.copy_from_slice(own_sub_vector))?;
            rank.recorder.end(EventName::Publish, Activity::Transfer, start, self.sub_vector_len as u64 * 4, 0);
        }
        Ok(())
    }

    /// y = A_ii v_i, or y += A_ii v_i, with the published sub-vector, the own rows of `u`.
    pub(super) fn multiply_own_block(
        &self,
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        accumulate: bool,
        u: &DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) {
        let own = rank.transport.rank() as u32;
        let start = rank.recorder.before_kernels();
        let own_rows = OwnRows { x: u, start: self.halo.plan().own.start, diagonal: 0 };
        self.kernel.apply_host(rank.executor, matrix.elastic, 0, accumulate, &self.staging, own_rows, y);
        if let Some(contact) = matrix.contact {
            self.kernel.apply_host(rank.executor, contact, 0, true, &self.staging, own_rows, y);
        }
        let (bytes, flops) = (matrix.section_bytes(0), matrix.section_flops(0));
        rank.recorder.end_transfer(EventName::SpmvBlock, Activity::Compute, start, (0, own, own), bytes, flops);
    }

    /// y += A_ij v_j with the sub-vector that arrives in stage `stage`; the own rows of `u` are v_i.
    pub(super) fn add_block(
        &self,
        rank: &mut RankContext<'_>,
        matrix: &SystemMatrix<'_>,
        stage: usize,
        v_j: &[f32],
        u: &DeviceVec<f32>,
        y: &mut DeviceVec<f32>,
    ) {
        let own = OwnRows { x: u, start: self.halo.plan().own.start, diagonal: NO_DIAGONAL };
        multiply_block(&self.kernel, rank.executor, rank.recorder, matrix, self.route(stage), v_j, own, y);
    }

    /// Copies the sub-vector that arrives in stage `stage` to `to`.
    pub(super) fn receive_sub_vector(
        &mut self,
        rank: &mut RankContext<'_>,
        stage: usize,
        to: &mut Vec<f32>,
    ) -> Result<(), TransportError> {
        let route = self.route(stage);
        receive_whole(rank.transport, route, &mut self.traffic, rank.recorder, |_, v_j| {
            to.clear();
            to.extend_from_slice(v_j);
        })
    }

    /// Number of stages of a product in `full` mode.
    pub(super) fn stages(&self) -> usize {
        self.queue.len()
    }

    /// (stage from 1, source, sub-vector) of an event.
    fn route(&self, stage: usize) -> (u32, u32, u32) {
        let node = &self.queue[stage];
        (stage as u32 + 1, node.source as u32, node.vector as u32)
    }
}

/// y += A_ij v_j for the sub-vector j of `route`.
#[expect(clippy::too_many_arguments, reason = "the operands of one product and where it is recorded")]
fn multiply_block(
    kernel: &Spmv,
    executor: &Executor,
    recorder: &mut Recorder,
    matrix: &SystemMatrix<'_>,
    route: (u32, u32, u32),
    v_j: &[f32],
    own: OwnRows<'_>,
    y: &mut DeviceVec<f32>,
) {
    let section = route.0 as usize;
    let start = recorder.before_kernels();
    for part in matrix.parts() {
        kernel.apply_host(executor, part, section, true, v_j, own, y);
    }
    let (bytes, flops) = (matrix.section_bytes(section), matrix.section_flops(section));
    recorder.end_transfer(EventName::SpmvBlock, Activity::Compute, start, route, bytes, flops);
}

/// Receives the sub-vector that `route` names and hands it to `take`.
fn receive_whole(
    transport: &mut dyn Transport,
    route: (u32, u32, u32),
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
    let start = recorder.now();
    transport.finish(vector, &mut |v_j| {
        recorder.end_transfer(EventName::Receive, Activity::Transfer, start, route, v_j.bytes(), 0);
        traffic.received_bytes += v_j.bytes();
        traffic.messages += 1;
        take(recorder, v_j.values());
    })?;
    Ok(())
}
