//! What a state has let go, as every rank holds it: see `let_go`.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};

use crate::forces::ContactElement;
use crate::model::LetGo;
use crate::scene::Obstacles;

/// What is let go, on every rank, and what it takes to find it.
pub(super) struct LetGoPairs {
    /// Ascending; vertices are global rows.
    pub pairs: Vec<LetGo>,
    /// Of the own rows of a state that was set, until the other ranks know; vertices are global rows.
    pub unshared: Vec<LetGo>,
    /// Vertices and triangles of every obstacle, in the numbering of the obstacles.
    pub ranges: Vec<[Range<usize>; 2]>,
    /// Whether an obstacle is closed; known once it was asked.
    pub closed: Vec<Option<bool>>,
    /// Contacts of this step that lead own vertices out again.
    pub ways_out: Vec<ContactElement>,
    /// Length of a whole step, seconds.
    pub step_s: f64,
}

impl LetGoPairs {
    pub(super) fn new(obstacles: &Obstacles, step_s: f64) -> LetGoPairs {
        let ranges = obstacles.ranges();
        let closed = vec![None; ranges.len()];
        LetGoPairs { pairs: Vec::new(), unshared: Vec::new(), ranges, closed, ways_out: Vec::new(), step_s }
    }

    /// Those of the rows of a rank, as a state holds them.
    pub(super) fn of_rows(&self, rows: Range<usize>) -> Vec<LetGo> {
        let own = self.pairs.iter().chain(&self.unshared).filter(|one| rows.contains(&(one.vertex as usize)));
        own.map(|one| LetGo { vertex: one.vertex - rows.start as u32, ..*one }).collect()
    }

    /// Those of a state that was set, for the own rows.
    pub(super) fn set(&mut self, own: &[LetGo], rows: Range<usize>) {
        assert!(own.iter().all(|one| (one.obstacle as usize) < self.ranges.len()), "obstacles of the scene");
        self.pairs.clear();
        self.unshared = own.iter().map(|one| LetGo { vertex: one.vertex + rows.start as u32, ..*one }).collect();
    }

    /// Whether a vertex has let go of one of two obstacles.
    pub(super) fn holds(&self, vertex: u32, obstacles: [usize; 2]) -> bool {
        let first = self.pairs.partition_point(|one| one.vertex < vertex);
        let mut of_vertex = self.pairs[first..].iter().take_while(|one| one.vertex == vertex);
        of_vertex.any(|one| obstacles.contains(&(one.obstacle as usize)))
    }
}

/// A place of the cloth that two obstacles press from opposite sides. Ranks exchange these.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Pressed {
    /// The smaller first.
    pub obstacles: [u32; 2],
    /// The vertex with the largest share in it; global row.
    pub vertex: u32,
    /// Meters.
    pub place: [f32; 3],
}
