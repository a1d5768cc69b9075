//! Where pins that follow an obstacle from the start take hold of it: from the scene alone, at time 0.

use crate::math::Vec3;
use crate::mesh::NearestPoint;
use crate::scene::{Grip, Obstacles, Pin, Scene};

/// The followed obstacles of a scene at time 0.
pub(super) struct Grips<'a> {
    scene: &'a Scene,
    positions: Vec<Vec3>,
    /// Triangles of every followed obstacle, in the numbering of all obstacles.
    triangles: Vec<&'a [[u32; 3]]>,
    /// Which triangles of all obstacles these are.
    ranges: Vec<std::ops::Range<usize>>,
}

impl<'a> Grips<'a> {
    /// `obstacles`: those of the scene as one surface.
    pub(super) fn new(scene: &'a Scene, obstacles: &'a Obstacles) -> Grips<'a> {
        if scene.followed.is_empty() {
            return Grips { scene, positions: Vec::new(), triangles: Vec::new(), ranges: Vec::new() };
        }
        let mut values = Vec::new();
        obstacles.positions_at(0.0, &mut values);
        let ranges = obstacles.ranges();
        let ranges: Vec<_> = scene.followed.iter().map(|&obstacle| ranges[obstacle as usize][1].clone()).collect();
        let triangles = ranges.iter().map(|range| &obstacles.triangles()[range.clone()]).collect();
        Grips { scene, positions: bytemuck::cast_slice(&values).to_vec(), triangles, ranges }
    }

    /// Triangles of the obstacle that a pin takes hold of while the cloth moves, first and end; none for other pins.
    pub(super) fn surface_of(&self, pin: &Pin) -> Option<[u32; 2]> {
        let followed = (pin.motion? as usize).checked_sub(self.scene.motions.len())?;
        let range = self.ranges.get(followed)?;
        pin.takes_hold_later(self.scene.motions.len()).then_some([range.start as u32, range.end as u32])
    }

    /// The grips of pins, in their order; none for pins that follow no obstacle, or take hold of it later. The nearest
    /// triangle counts, of several the first.
    pub(super) fn of_pins(&self, pins: &[Pin]) -> Vec<Option<Grip>> {
        let surfaces: Vec<NearestPoint> =
            self.triangles.iter().map(|triangles| NearestPoint::new(&self.positions, triangles)).collect();
        let grip = |pin: &Pin| {
            let followed = (pin.motion? as usize).checked_sub(self.scene.motions.len())?;
            if pin.takes_hold_later(self.scene.motions.len()) {
                return None;
            }
            let point = self.scene.mesh.positions[pin.vertex as usize].as_dvec3();
            let foot = surfaces[followed].to(point)?;
            let vertices = self.triangles[followed][foot.triangle];
            let corners = vertices.map(|v| self.positions[v as usize].as_dvec3());
            Some(Grip::new(vertices, corners, foot.weights, point))
        };
        pins.iter().map(grip).collect()
    }
}
