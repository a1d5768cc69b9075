//! Elastic elements of a rank and their records of a step. Matrix and right-hand side read the records only.

use std::borrow::Cow;
use std::collections::HashMap;

use bytemuck::Zeroable;

use super::own_state::StateVectors;
use super::span::Span;
use crate::forces::bend::Bend;
use crate::forces::crease;
use crate::forces::fiber::{self, TautFibers};
use crate::forces::plastic_stretch::{self, NO_HINGE, PlasticTriangle};
use crate::forces::stitch::{self, RECORDS_STITCH, StitchElement, StitchParams};
use crate::forces::stretch::Stretch;
use crate::forces::{
    FabricTable, HINGE_RECORD_FLOATS, HingeElement, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement,
};
use crate::gpu::{DeviceVec, Executor, WINDOW_STEP};
use crate::model::RankArrays;
use crate::scene::{Closing, Settings};

/// Triangles and hinges that touch own rows.
pub(super) struct Elements {
    fabrics: DeviceVec<FabricTable>,
    /// Factor on the stiffness of `fabric_tables` that `fabrics` has.
    stiffened: f32,
    /// Local vertices.
    pub triangles: DeviceVec<TriangleElement>,
    /// Local vertices: the hinges, then a fiber per triangle if a fabric has a strain limit, and from
    /// `first_stitch` on three per thread of a seam.
    pub hinges: DeviceVec<HingeElement>,
    /// As `forces::stretch` lays them out.
    pub triangle_records: DeviceVec<f32>,
    /// As `forces::bend` lays them out.
    pub hinge_records: DeviceVec<f32>,
    stretch: Stretch,
    bend: Bend,
    /// Hinges without fibers.
    bends: usize,
    /// Fibers in `hinges`; none if no fabric has a strain limit.
    pub fibers: TautFibers,
    /// True if a fabric has a strain limit that fibers keep.
    is_limited: bool,
    stitches: DeviceVec<StitchElement>,
    first_stitch: usize,
    closing: Option<Closing>,
    /// Plastic curvature over yield curvature of every hinge; empty if the folds of no fabric stay.
    hinge_damage: DeviceVec<f32>,
    /// Of every triangle; empty if neither shapes at rest nor damage of triangles change.
    pub plastic_triangles: DeviceVec<PlasticTriangle>,
    /// True if a fabric stays stretched.
    stays_stretched: bool,
    fabric_tables: Vec<FabricTable>,
}

impl Elements {
    /// `creases`: the folds of a fabric of the scene stay.
    pub(super) fn new(executor: &Executor, arrays: &RankArrays, creases: bool, closing: Option<Closing>) -> Elements {
        let bends = arrays.hinges.len();
        let mut hinges = Cow::Borrowed(&arrays.hinges);
        let is_limited = arrays.fabrics.iter().any(FabricTable::has_fibers);
        if is_limited {
            let hinges = hinges.to_mut();
            fill_window(executor, hinges);
            hinges.extend(arrays.triangles.iter().map(fiber::element));
        }
        let changes_triangles = arrays.fabrics.iter().any(FabricTable::changes_triangles);
        let plastic_triangles = if changes_triangles { plastic_triangles(arrays, creases) } else { Vec::new() };
        let first_fiber = if is_limited { hinges.len() - arrays.triangles.len() } else { bends };
        let fibers = if is_limited { arrays.triangles.len() } else { 0 };
        if !arrays.stitches.is_empty() {
            let hinges = hinges.to_mut();
            fill_window(executor, hinges);
            hinges.extend(arrays.stitches.iter().flat_map(StitchElement::hinges));
        }
        let first_stitch = hinges.len() - RECORDS_STITCH * arrays.stitches.len();
        let mut elements = Elements {
            bends,
            fibers: TautFibers::new(executor, first_fiber, fibers),
            is_limited,
            stitches: DeviceVec::upload(executor, &arrays.stitches),
            first_stitch,
            closing,
            fabrics: DeviceVec::upload(executor, &arrays.fabrics),
            triangles: DeviceVec::upload(executor, &arrays.triangles),
            hinges: DeviceVec::upload(executor, &hinges),
            triangle_records: DeviceVec::zeros(executor, arrays.triangles.len() * TRIANGLE_RECORD_FLOATS),
            hinge_records: DeviceVec::zeros(executor, hinges.len() * HINGE_RECORD_FLOATS),
            stretch: Stretch::new(executor),
            bend: Bend::new(executor),
            hinge_damage: DeviceVec::zeros(executor, if creases { bends } else { 0 }),
            plastic_triangles: DeviceVec::upload(executor, &plastic_triangles),
            stays_stretched: !arrays.stretches.is_empty(),
            fabric_tables: arrays.fabrics.clone(),
            stiffened: 1.0,
        };
        elements.take_up_plastic(executor);
        elements
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
        let (fabrics, stretched, bent) = (&self.fabrics, &mut self.triangle_records, &mut self.hinge_records);
        if self.is_limited {
            let (stretch, fibers) = (&self.stretch, &self.fibers);
            fiber::apply(executor, stretch, &triangles, fabrics, &self.triangles, x, v, stretched, fibers, bent);
        } else {
            self.stretch.apply(executor, &triangles, fabrics, &self.triangles, x, v, stretched);
        }
        self.bend.apply(executor, &hinges, fabrics, &self.hinges, x, v, bent);
        if let (Some(closing), false) = (&self.closing, self.stitches.is_empty()) {
            let params = StitchParams::new(span.length_s as f32, ahead_s as f32, closing, span.end_s);
            stitch::apply(executor, &params, &self.stitches, x, v, self.first_stitch, bent);
        }
    }

    /// Gives all fabrics `factor` times the stiffness that the scene gives them.
    pub(super) fn stiffen(&mut self, executor: &Executor, factor: f32) {
        if std::mem::replace(&mut self.stiffened, factor) != factor {
            let fabrics: Vec<FabricTable> = self.fabric_tables.iter().map(|fabric| fabric.stiffened(factor)).collect();
            self.fabrics.write_range(executor, 0, &fabrics);
        }
    }

    /// Number of hinges, fibers and threads not counted.
    pub(super) fn bends(&self) -> usize {
        self.bends
    }

    /// True if a fabric is plastic.
    pub(super) fn is_plastic(&self) -> bool {
        self.crease_count() > 0 || self.stretch_count() > 0
    }

    /// Number of creases that a state has.
    pub(super) fn crease_count(&self) -> usize {
        self.hinge_damage.len()
    }

    /// Number of rest stretches that a state has.
    pub(super) fn stretch_count(&self) -> usize {
        if self.stays_stretched { self.triangles.len() } else { 0 }
    }

    /// Bytes that [`Elements::yield_beyond`] reads.
    pub(super) fn plastic_bytes(&self) -> u64 {
        let triangles = if self.plastic_triangles.is_empty() { 0 } else { self.triangles.bytes() };
        self.hinge_damage.bytes() * 13 + self.plastic_triangles.bytes() + triangles
    }

    /// The return maps of all hinges and triangles (`forces::crease`, `forces::plastic_stretch`).
    pub(super) fn yield_beyond(&mut self, executor: &Executor, positions: &DeviceVec<f32>) {
        if self.crease_count() > 0 {
            crease::apply(executor, &self.fabrics, positions, &mut self.hinges, &mut self.hinge_damage);
        }
        self.stretch_beyond(executor, true, positions);
    }

    fn stretch_beyond(&mut self, executor: &Executor, moves: bool, positions: &DeviceVec<f32>) {
        if !self.plastic_triangles.is_empty() {
            let (fabrics, damage) = (&self.fabrics, &self.hinge_damage);
            let (plastic, elements) = (&mut self.plastic_triangles, &mut self.triangles);
            plastic_stretch::apply(executor, moves, fabrics, positions, damage, plastic, elements);
        }
    }

    /// Brings damage and triangles in line with the creases and rest stretches that the elements hold.
    pub(super) fn take_up_plastic(&mut self, executor: &Executor) {
        if self.crease_count() > 0 && !self.plastic_triangles.is_empty() {
            let hinges = self.hinges.host(executor);
            let damage = |hinge: &HingeElement| crease::damage(&self.fabric_tables, hinge);
            let damage: Vec<f32> = hinges[..self.bends].iter().map(damage).collect();
            self.hinge_damage.write_range(executor, 0, &damage);
        }
        // Nothing moves, so no position is read.
        self.stretch_beyond(executor, false, &DeviceVec::zeros(executor, 1));
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
        self.fabrics.bytes() + self.moved_bytes() + self.hinge_damage.bytes() + self.plastic_triangles.bytes()
    }
}

/// The plastic data of the triangles of a rank at its start. All hinges of a triangle of a rank are there, too.
fn plastic_triangles(arrays: &RankArrays, creases: bool) -> Vec<PlasticTriangle> {
    let side = |a: u32, b: u32| [a.min(b), a.max(b)];
    let ends = |hinge: &HingeElement| side(hinge.vertices[0], hinge.vertices[1]);
    let of_side: HashMap<[u32; 2], u32> = arrays.hinges.iter().filter(|_| creases).map(ends).zip(0..).collect();
    let with_hinges = |element: &TriangleElement| {
        let [a, b, c] = element.vertices;
        let hinge = |[a, b]: [u32; 2]| of_side.get(&side(a, b)).copied().unwrap_or(NO_HINGE);
        PlasticTriangle::new(element, [[a, b], [b, c], [c, a]].map(hinge))
    };
    let mut triangles: Vec<PlasticTriangle> = arrays.triangles.iter().map(with_hinges).collect();
    triangles.iter_mut().zip(&arrays.stretches).for_each(|(triangle, &stretch)| triangle.set_state(stretch));
    triangles
}

/// Fills up a list of hinges, so that what follows begins where kernels can see it through a binding of its own. What
/// it is filled with belongs to no row.
fn fill_window(executor: &Executor, hinges: &mut Vec<HingeElement>) {
    if let Executor::Gpu(_) = executor {
        let nowhere = HingeElement { vertices: [u32::MAX; 4], ..HingeElement::zeroed() };
        hinges.resize(hinges.len().next_multiple_of(WINDOW_STEP), nowhere);
    }
}
