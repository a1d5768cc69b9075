//! One rank's part of the model: the elements that touch its rows, its halo, its pins. Built by the coordinator, sent to
//! the worker as a small header and flat arrays.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::GlobalModel;
use crate::forces::{FabricTable, HingeElement, TriangleElement};
use crate::integrator::pins::RankPin;
use crate::partition::{HaloPlan, RowPartition, halo_plans};
use crate::scene::{Motion, Settings};

/// Everything a worker needs to simulate its rows. Vertices are local indices of `plan`.
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
    /// Numbers of the run.
    pub settings: Settings,
    /// True if any pin of any rank moves or lets go: then the solve starts from prescribed values.
    pub pins_move: bool,
    /// Bulk data; travels beside the header.
    #[serde(skip)]
    pub arrays: RankArrays,
}

/// Flat arrays of a [`RankModel`].
#[derive(Clone, Debug, Default)]
pub struct RankArrays {
    /// Positions of local vertices, xyz, metres.
    pub positions: Vec<f32>,
    /// Velocities of local vertices, xyz, m/s.
    pub velocities: Vec<f32>,
    /// Masses of own rows, kg.
    pub masses: Vec<f32>,
    /// Stretch elements that touch own rows, in global order.
    pub triangles: Vec<TriangleElement>,
    /// Bending elements that touch own rows, in global order.
    pub hinges: Vec<HingeElement>,
    /// Fabrics.
    pub fabrics: Vec<FabricTable>,
}

/// Why bytes are not the arrays of a model.
#[derive(Debug, Error)]
pub enum RankModelError {
    /// Wrong number of arrays or an array of the wrong length.
    #[error("model of a rank: {0}")]
    Arrays(String),
}

impl RankModel {
    /// Splits `model` over the ranks of `partition`; `emit` receives the parts in rank order, one at a time, so that only one
    /// of them exists at once.
    pub fn split<E>(
        model: &GlobalModel,
        partition: &RowPartition,
        mut emit: impl FnMut(usize, RankModel) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut halos = vec![Vec::new(); partition.ranks()];
        for corners in
            model.triangles.iter().map(|e| &e.vertices[..]).chain(model.hinges.iter().map(|e| &e.vertices[..]))
        {
            collect_halo(partition, corners, &mut halos);
        }
        for halo in &mut halos {
            halo.sort_unstable();
            halo.dedup();
        }
        let pins_move = model.pins.iter().any(|pin| pin.motion.is_some() || pin.start_s > 0.0)
            || model.pins.iter().any(|pin| model.velocities[pin.row as usize * 3..][..3] != [0.0; 3]);
        for (rank, plan) in halo_plans(partition, &halos).into_iter().enumerate() {
            emit(rank, RankModel::part(model, partition, plan, pins_move))?;
        }
        Ok(())
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
        let hinges = model
            .hinges
            .iter()
            .filter(|e| e.vertices.iter().any(owned))
            .map(|e| HingeElement { vertices: e.vertices.map(local), ..*e })
            .collect();
        let pins = model
            .pins
            .iter()
            .filter(|pin| owned(&pin.row))
            .map(|pin| RankPin { row: pin.row - rows.start as u32, ..*pin })
            .collect();
        let arrays = RankArrays {
            positions: gather(&model.positions),
            velocities: gather(&model.velocities),
            masses: model.masses[rows.clone()].to_vec(),
            triangles,
            hinges,
            fabrics: model.fabrics.clone(),
        };
        RankModel {
            partition: *partition,
            pins,
            motions: model.motions.clone(),
            settings: model.settings.clone(),
            pins_move,
            arrays,
            plan,
        }
    }
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

impl RankArrays {
    /// The arrays as bytes, in a fixed order.
    pub fn to_bytes(&self) -> [&[u8]; 6] {
        [
            bytemuck::cast_slice(&self.positions),
            bytemuck::cast_slice(&self.velocities),
            bytemuck::cast_slice(&self.masses),
            bytemuck::cast_slice(&self.triangles),
            bytemuck::cast_slice(&self.hinges),
            bytemuck::cast_slice(&self.fabrics),
        ]
    }

    /// The arrays from bytes in the order of [`RankArrays::to_bytes`].
    pub fn from_bytes(bytes: &[&[u8]]) -> Result<RankArrays, RankModelError> {
        let [positions, velocities, masses, triangles, hinges, fabrics] = bytes else {
            return Err(RankModelError::Arrays(format!("{} arrays instead of 6", bytes.len())));
        };
        Ok(RankArrays {
            positions: cast(positions)?,
            velocities: cast(velocities)?,
            masses: cast(masses)?,
            triangles: cast(triangles)?,
            hinges: cast(hinges)?,
            fabrics: cast(fabrics)?,
        })
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
