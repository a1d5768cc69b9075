//! One rank's part of the model: the elements that touch its rows, its halo, its pins. The coordinator builds it and
//! sends it to the worker as a small header and flat arrays.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{CollisionArrays, CollisionModel, GlobalModel, PlasticElements, RestStretch};
use crate::forces::stitch::StitchElement;
use crate::forces::{FabricTable, HingeElement, TriangleElement};
use crate::integrator::pins::RankPin;
use crate::partition::{HaloPlan, RowPartition, halo_plans};
use crate::scene::{Closing, Motion, ObstacleHeader, Obstacles, Settings};

/// All data that a worker needs to simulate its rows. Vertices are local indices of `plan`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RankModel {
    /// Rows and ranks.
    pub partition: RowPartition,
    /// Halo of this rank.
    pub plan: HaloPlan,
    /// Pins on own rows.
    pub pins: Vec<RankPin>,
    /// Motions of the pins of all ranks.
    pub motions: Vec<Motion>,
    /// Vertices of obstacles that the grips of the pins name.
    pub followed: ObstacleHeader,
    /// Whole obstacles that pins on own rows take hold of while the cloth moves.
    pub surfaces: ObstacleHeader,
    /// True if a pin of any rank is a spring.
    pub springs: bool,
    /// Parameters of the run.
    pub settings: Settings,
    /// Mean of the smallest altitudes of the triangles at rest, meters.
    pub cell_m: f64,
    /// True if a pin of any rank moves or takes hold later. Then every solve starts from prescribed values.
    pub pins_move: bool,
    /// As [`GlobalModel::stiffness_ratio`].
    pub stiffness_ratio: f64,
    /// True if folds of a fabric of the scene stay. Then the state has creases.
    pub plastic: bool,
    /// How the threads of seams shorten; none without seams.
    pub closing: Option<Closing>,
    /// Collision data of the whole scene; none if the scene disables collisions.
    pub collision: Option<CollisionModel>,
    /// Bulk data; sent unserialized after the header.
    #[serde(skip)]
    pub arrays: RankArrays,
}

/// Flat arrays of a [`RankModel`].
#[derive(Clone, Debug, Default)]
pub struct RankArrays {
    /// Positions of local vertices, xyz, meters.
    pub positions: Vec<f32>,
    /// Velocities of local vertices, xyz, m/s.
    pub velocities: Vec<f32>,
    /// Masses of own rows, kg.
    pub masses: Vec<f32>,
    /// Stretch elements that touch own rows, in global order.
    pub triangles: Vec<TriangleElement>,
    /// Bending elements that touch own rows, in global order.
    pub hinges: Vec<HingeElement>,
    /// Rest stretch of every triangle; empty if no fabric of the scene stays stretched.
    pub stretches: Vec<RestStretch>,
    /// Fabrics.
    pub fabrics: Vec<FabricTable>,
    /// Positions of the followed vertices, as [`crate::scene::Obstacles::arrays`] gives them.
    pub followed: Vec<f32>,
    /// Threads of seams that touch own rows, in global order.
    pub stitches: Vec<StitchElement>,
    /// As [`crate::integrator::surfaces::Surfaces`] has them.
    pub surface_vertices: Vec<u32>,
    /// As [`crate::scene::Obstacles::arrays`] gives them.
    pub surface_positions: Vec<f32>,
    /// As [`crate::integrator::surfaces::Surfaces`] has them.
    pub surface_triangles: Vec<[u32; 3]>,
}

/// Error of bytes that are not the arrays of a model.
#[derive(Debug, Error)]
pub enum RankModelError {
    /// Wrong number of arrays or an array of the wrong length.
    #[error("model of a rank: {0}")]
    Arrays(String),
}

impl RankModel {
    /// Splits `model` over the ranks of `partition`. `emit` receives the parts one at a time in rank order, so that
    /// only one of them exists at once.
    pub fn split<E>(
        model: &GlobalModel,
        partition: &RowPartition,
        mut emit: impl FnMut(usize, RankModel) -> Result<(), E>,
    ) -> Result<(), E> {
        let collision = model.settings.collisions.then(|| CollisionModel::new(model));
        let moves = |pin: &RankPin| pin.stiffness_n_m.is_none() && (pin.motion.is_some() || pin.start_s > 0.0);
        let pins_move = model.pins.iter().any(moves);
        for (rank, plan) in RankModel::halo_plans(model, partition).into_iter().enumerate() {
            let mut part = RankModel::part(model, partition, plan, pins_move);
            part.collision.clone_from(&collision);
            emit(rank, part)?;
        }
        Ok(())
    }

    /// Halo rows that the ranks read of each other without contacts.
    pub fn halo_plans(model: &GlobalModel, partition: &RowPartition) -> Vec<HaloPlan> {
        let mut halos = vec![Vec::new(); partition.ranks()];
        let triangles = model.triangles.iter().map(|e| &e.vertices[..]);
        let hinges = model.hinges.iter().map(|e| &e.vertices[..]);
        let stitches = model.stitches.iter().map(|e| &e.vertices[..]);
        for corners in triangles.chain(hinges).chain(stitches) {
            collect_halo(partition, corners, &mut halos);
        }
        for halo in &mut halos {
            halo.sort_unstable();
            halo.dedup();
        }
        halo_plans(partition, &halos)
    }

    /// Elements of the mesh that touch the rows of every rank, in the order of the ranks' elements, as
    /// [`super::State::gather`] takes them.
    pub fn plastic_elements(model: &GlobalModel, partition: &RowPartition) -> Vec<PlasticElements> {
        let mut of_ranks = vec![PlasticElements::default(); partition.ranks()];
        for (element, &hinge) in model.hinges.iter().zip(&model.original_hinge) {
            owners(partition, element.vertices).for_each(|owner| of_ranks[owner].hinges.push(hinge));
        }
        for (element, &triangle) in model.triangles.iter().zip(&model.original_triangle) {
            owners(partition, element.vertices).for_each(|owner| of_ranks[owner].triangles.push(triangle));
        }
        of_ranks
    }

    fn part(model: &GlobalModel, partition: &RowPartition, plan: HaloPlan, pins_move: bool) -> RankModel {
        let rows = partition.rows_of(plan.rank);
        let owned = |v: &u32| rows.contains(&(*v as usize));
        let local = |v: u32| {
            let own = (v as usize).wrapping_sub(rows.start);
            if own < rows.len() {
                (plan.own.start + own) as u32
            } else {
                plan.local_from_global(v).expect("halo holds every vertex of the rank's elements")
            }
        };
        let gather = |values: &[f32]| {
            plan.global_from_local.iter().flat_map(|&g| values[g as usize * 3..][..3].iter().copied()).collect()
        };
        let triangles = model
            .triangles
            .iter()
            .filter(|e| e.vertices.iter().any(owned))
            .map(|e| TriangleElement { vertices: e.vertices.map(local), ..*e })
            .collect();
        let touches = |(e, _): &(&TriangleElement, &RestStretch)| e.vertices.iter().any(owned);
        let stretches = model.triangles.iter().zip(&model.stretches).filter(touches).map(|(_, &s)| s).collect();
        let hinges = model
            .hinges
            .iter()
            .filter(|e| e.vertices.iter().any(owned))
            .map(|e| HingeElement { vertices: e.vertices.map(local), ..*e })
            .collect();
        let stitches = model
            .stitches
            .iter()
            .filter(|e| e.vertices.iter().any(owned))
            .map(|e| StitchElement { vertices: e.vertices.map(local), ..*e })
            .collect();
        let mut pins: Vec<RankPin> = model
            .pins
            .iter()
            .filter(|pin| owned(&pin.row))
            .map(|pin| RankPin { row: pin.row - rows.start as u32, ..*pin })
            .collect();
        let followed = model.obstacles.only(&renumber_grips(&mut pins));
        let (surface_vertices, surface_triangles) = renumber_surfaces(&mut pins, &model.obstacles);
        let surfaces = model.obstacles.only(&surface_vertices);
        let arrays = RankArrays {
            positions: gather(&model.positions),
            velocities: gather(&model.velocities),
            masses: model.masses[rows.clone()].to_vec(),
            triangles,
            hinges,
            stretches,
            fabrics: model.fabrics.clone(),
            followed: followed.arrays().0.to_vec(),
            stitches,
            surface_vertices,
            surface_positions: surfaces.arrays().0.to_vec(),
            surface_triangles,
        };
        RankModel {
            partition: *partition,
            pins,
            motions: model.motions.clone(),
            followed: followed.header().clone(),
            surfaces: surfaces.header().clone(),
            springs: model.pins.iter().any(|pin| pin.stiffness_n_m.is_some()),
            settings: model.settings.clone(),
            cell_m: model.cell_m(),
            pins_move,
            stiffness_ratio: model.stiffness_ratio,
            plastic: !model.original_hinge.is_empty(),
            closing: model.closing,
            collision: None,
            arrays,
            plan,
        }
    }
}

/// Numbers the vertices that grips name from 0 on, and returns which vertices of the obstacles they are, ascending.
fn renumber_grips(pins: &mut [RankPin]) -> Vec<u32> {
    let mut named: Vec<u32> = pins.iter().flat_map(|pin| pin.grip).flat_map(|grip| grip.vertices).collect();
    named.sort_unstable();
    named.dedup();
    for vertex in pins.iter_mut().flat_map(|pin| &mut pin.grip).flat_map(|grip| &mut grip.vertices) {
        *vertex = named.partition_point(|other| other < vertex) as u32;
    }
    named
}

/// Lists the vertices and triangles of the obstacles that pins take hold of later, each obstacle once; vertices are
/// those of all obstacles, ascending, triangles number these from 0 on, and so do the ranges of the pins.
fn renumber_surfaces(pins: &mut [RankPin], obstacles: &Obstacles) -> (Vec<u32>, Vec<[u32; 3]>) {
    let mut ranges: Vec<[u32; 2]> = pins.iter().filter_map(|pin| pin.surface).collect();
    ranges.sort_unstable();
    ranges.dedup();
    let named = |&[first, end]: &[u32; 2]| &obstacles.triangles()[first as usize..end as usize];
    let mut vertices: Vec<u32> = ranges.iter().flat_map(named).flatten().copied().collect();
    vertices.sort_unstable();
    vertices.dedup();
    let local = |v: u32| vertices.partition_point(|&other| other < v) as u32;
    let triangles = ranges.iter().flat_map(named).map(|corners| corners.map(local)).collect();
    for surface in pins.iter_mut().filter_map(|pin| pin.surface.as_mut()) {
        let before = ranges.iter().take_while(|range| *range < surface);
        let first = before.map(|[first, end]| end - first).sum::<u32>();
        *surface = [first, first + surface[1] - surface[0]];
    }
    (vertices, triangles)
}

/// Ranks that own one of the vertices of an element, each once.
fn owners<const N: usize>(partition: &RowPartition, vertices: [u32; N]) -> impl Iterator<Item = usize> {
    let mut owners = vertices.map(|v| partition.owner(v as usize));
    owners.sort_unstable();
    (0..N).filter(move |&i| i == 0 || owners[i - 1] != owners[i]).map(move |i| owners[i])
}

fn collect_halo(partition: &RowPartition, corners: &[u32], halos: &mut [Vec<u32>]) {
    let owners = corners.iter().map(|&v| partition.owner(v as usize));
    let mut owner_of = [0; 4];
    for (to, owner) in owner_of.iter_mut().zip(owners) {
        *to = owner;
    }
    let owner_of = &owner_of[..corners.len()];
    if owner_of.iter().all(|&o| o == owner_of[0]) {
        return;
    }
    for &rank in owner_of {
        for (&v, &owner) in corners.iter().zip(owner_of) {
            if owner != rank {
                halos[rank].push(v);
            }
        }
    }
}

impl RankModel {
    /// All bulk arrays as bytes, in a fixed order.
    pub fn to_bytes(&self) -> Vec<&[u8]> {
        let collision = self.collision.iter().flat_map(|collision| collision.arrays.to_bytes());
        self.arrays.to_bytes().into_iter().chain(collision).collect()
    }

    /// Sets the bulk arrays from bytes in the order of [`RankModel::to_bytes`].
    pub fn set_arrays(&mut self, bytes: &[&[u8]]) -> Result<(), RankModelError> {
        let expected = if self.collision.is_some() { 22 } else { 12 };
        if bytes.len() != expected {
            return Err(RankModelError::Arrays(format!("{} arrays instead of {expected}", bytes.len())));
        }
        let (own, all) = bytes.split_at(12);
        self.arrays = RankArrays {
            positions: cast(own[0])?,
            velocities: cast(own[1])?,
            masses: cast(own[2])?,
            triangles: cast(own[3])?,
            hinges: cast(own[4])?,
            stretches: cast(own[5])?,
            fabrics: cast(own[6])?,
            followed: cast(own[7])?,
            stitches: cast(own[8])?,
            surface_vertices: cast(own[9])?,
            surface_positions: cast(own[10])?,
            surface_triangles: cast(own[11])?,
        };
        if let Some(collision) = &mut self.collision {
            collision.arrays = CollisionArrays {
                triangles: cast(all[0])?,
                altitudes_m: cast(all[1])?,
                masses: cast(all[2])?,
                friction: cast(all[3])?,
                obstacle_positions: cast(all[4])?,
                obstacle_triangles: cast(all[5])?,
                sewn: cast(all[6])?,
                friction_factors: cast(all[7])?,
                thickness_factors: cast(all[8])?,
                near_sewn: cast(all[9])?,
            };
        }
        Ok(())
    }
}

impl RankArrays {
    fn to_bytes(&self) -> [&[u8]; 12] {
        [
            bytemuck::cast_slice(&self.positions),
            bytemuck::cast_slice(&self.velocities),
            bytemuck::cast_slice(&self.masses),
            bytemuck::cast_slice(&self.triangles),
            bytemuck::cast_slice(&self.hinges),
            bytemuck::cast_slice(&self.stretches),
            bytemuck::cast_slice(&self.fabrics),
            bytemuck::cast_slice(&self.followed),
            bytemuck::cast_slice(&self.stitches),
            bytemuck::cast_slice(&self.surface_vertices),
            bytemuck::cast_slice(&self.surface_positions),
            bytemuck::cast_slice(&self.surface_triangles),
        ]
    }
}

fn cast<T: bytemuck::Pod>(bytes: &[u8]) -> Result<Vec<T>, RankModelError> {
    if !bytes.len().is_multiple_of(size_of::<T>()) {
        return Err(RankModelError::Arrays(format!(
            "{} bytes are not a whole number of {}-byte items",
            bytes.len(),
            size_of::<T>()
        )));
    }
    let mut out = vec![T::zeroed(); bytes.len() / size_of::<T>()];
    bytemuck::cast_slice_mut(&mut out).copy_from_slice(bytes);
    Ok(out)
}
