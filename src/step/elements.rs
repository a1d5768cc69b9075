//! Elastic elements of a rank and their records of a step. Matrix and right-hand side read the records only.

use super::own_state::StateVectors;
use super::span::Span;
use crate::forces::bend::Bend;
use crate::forces::crease;
use crate::forces::stretch::Stretch;
use crate::forces::{
    FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement,
};
use crate::gpu::{DeviceVec, Executor};
use crate::model::RankArrays;
use crate::scene::Settings;

/// Triangles and hinges that touch own rows.
pub(super) struct Elements {
    fabrics: DeviceVec<FabricTable>,
    /// Local vertices.
    pub triangles: DeviceVec<TriangleElement>,
    /// Local vertices.
    pub hinges: DeviceVec<HingeElement>,
    /// As `forces::stretch` lays them out.
    pub triangle_records: DeviceVec<f32>,
    /// As `forces::bend` lays them out.
    pub hinge_records: DeviceVec<f32>,
    stretch: Stretch,
    bend: Bend,
    /// True if a fabric is plastic; then hinges change from step to step.
    plastic: bool,
}

impl Elements {
    pub(super) fn new(executor: &Executor, arrays: &RankArrays, plastic: bool) -> Elements {
        Elements {
            fabrics: DeviceVec::upload(executor, &arrays.fabrics),
            triangles: DeviceVec::upload(executor, &arrays.triangles),
            hinges: DeviceVec::upload(executor, &arrays.hinges),
            triangle_records: DeviceVec::zeros(executor, arrays.triangles.len() * TRIANGLE_RECORD_FLOATS),
            hinge_records: DeviceVec::zeros(executor, arrays.hinges.len() * HINGE_RECORD_FLOATS),
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
        let (triangles, hinges) = (params(self.triangles.len()), params(self.hinges.len()));
        let (fabrics, records) = (&self.fabrics, &mut self.triangle_records);
        self.stretch.apply(executor, &triangles, fabrics, &self.triangles, x, v, records);
        self.bend.apply(executor, &hinges, fabrics, &self.hinges, x, v, &mut self.hinge_records);
    }

    /// True if a fabric is plastic.
    pub(super) fn is_plastic(&self) -> bool {
        self.plastic
    }

    /// The return map of all hinges (`forces::crease`).
    pub(super) fn crease(&mut self, executor: &Executor, positions: &DeviceVec<f32>) {
        crease::apply(executor, &self.fabrics, positions, &mut self.hinges);
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
