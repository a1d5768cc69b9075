//! Elastic elements of a rank and their records of a step. Matrix and right-hand side read the records only.

use std::borrow::Cow;

use bytemuck::Zeroable;

use super::own_state::StateVectors;
use super::span::Span;
use crate::forces::bend::Bend;
use crate::forces::crease;
use crate::forces::fiber;
use crate::forces::stretch::Stretch;
use crate::forces::{
    FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement,
};
use crate::gpu::{DeviceVec, Executor, WINDOW_STEP};
use crate::model::RankArrays;
use crate::scene::Settings;

/// Triangles and hinges that touch own rows.
pub(super) struct Elements {
    fabrics: DeviceVec<FabricTable>,
    /// Local vertices.
    pub triangles: DeviceVec<TriangleElement>,
    /// Local vertices: the hinges, and from `first_fiber` on a fiber per triangle if a fabric has a strain limit.
    pub hinges: DeviceVec<HingeElement>,
    /// As `forces::stretch` lays them out.
    pub triangle_records: DeviceVec<f32>,
    /// As `forces::bend` lays them out.
    pub hinge_records: DeviceVec<f32>,
    stretch: Stretch,
    bend: Bend,
    /// Hinges without fibers.
    bends: usize,
    /// First fiber in `hinges`; as many as there are if no fabric has a strain limit.
    first_fiber: usize,
    /// True if a fabric is plastic; then hinges change from step to step.
    plastic: bool,
}

impl Elements {
    pub(super) fn new(executor: &Executor, arrays: &RankArrays, plastic: bool) -> Elements {
        let bends = arrays.hinges.len();
        let mut hinges = Cow::Borrowed(&arrays.hinges);
        let is_limited = arrays.fabrics.iter().any(FabricTable::has_fibers);
        if is_limited {
            let hinges = hinges.to_mut();
            if let Executor::Gpu(_) = executor {
                // Kernels see the fibers through bindings that begin at such places. What lies before the first fiber
                // belongs to no row.
                let nowhere = HingeElement { vertices: [u32::MAX; 4], ..HingeElement::zeroed() };
                hinges.resize(bends.next_multiple_of(WINDOW_STEP), nowhere);
            }
            hinges.extend(arrays.triangles.iter().map(fiber::element));
        }
        let first_fiber = if is_limited { hinges.len() - arrays.triangles.len() } else { bends };
        Elements {
            bends,
            first_fiber,
            fabrics: DeviceVec::upload(executor, &arrays.fabrics),
            triangles: DeviceVec::upload(executor, &arrays.triangles),
            hinges: DeviceVec::upload(executor, &hinges),
            triangle_records: DeviceVec::zeros(executor, arrays.triangles.len() * TRIANGLE_RECORD_FLOATS),
            hinge_records: DeviceVec::zeros(executor, hinges.len() * HINGE_RECORD_FLOATS),
            stretch: Stretch::new(executor),
            bend: Bend::new(executor),
            plastic,
        }
    }

    /// The records of `state` for a step over `span`. `ahead_s`: see [`StepParams::ahead_s`].
    pub(super) fn fill_records(
        &mut self,
        executor: &Executor,
        settings: &Settings,
        span: Span,
        ahead_s: f64,
        state: &StateVectors,
    ) {
        let params = |count: usize| StepParams {
            step_s: span.length_s as f32,
            air_density: settings.air_density_kg_m3 as f32,
            air_drag: settings.air_drag_kg_m2_s as f32,
            count: count as u32,
            wind: settings.wind_m_s.to_array(),
            ahead_s: ahead_s as f32,
        };
        let (x, v) = (&state.positions, &state.velocities);
        let (triangles, hinges) = (params(self.triangles.len()), params(self.bends));
        let (fabrics, records) = (&self.fabrics, &mut self.triangle_records);
        self.stretch.apply(executor, &triangles, fabrics, &self.triangles, x, v, records);
        let records = &mut self.hinge_records;
        self.bend.apply(executor, &hinges, fabrics, &self.hinges, x, v, records);
        if self.first_fiber < self.hinges.len() {
            fiber::apply(executor, &triangles, fabrics, &self.triangles, x, v, self.first_fiber, records);
        }
    }

    /// Number of hinges, fibers not counted.
    pub(super) fn bends(&self) -> usize {
        self.bends
    }

    /// True if a fabric is plastic.
    pub(super) fn is_plastic(&self) -> bool {
        self.plastic
    }

    /// The return map of all hinges (`forces::crease`).
    pub(super) fn crease(&mut self, executor: &Executor, positions: &DeviceVec<f32>) {
        crease::apply(executor, &self.fabrics, positions, self.bends, &mut self.hinges);
    }

    /// Bytes that [`Elements::fill_records`] moves.
    pub(super) fn moved_bytes(&self) -> u64 {
        self.triangles.bytes() + self.hinges.bytes() + self.triangle_records.bytes() + self.hinge_records.bytes()
    }

    /// Floating-point operations of [`Elements::fill_records`], about.
    pub(super) fn flops(&self) -> u64 {
        self.triangles.len() as u64 * 300 + self.hinges.len() as u64 * 200
    }

    /// Device bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.fabrics.bytes() + self.moved_bytes()
    }
}
