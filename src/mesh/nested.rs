//! Sheets of nested levels: an irregular triangulation whose triangles are divided into four, again and again.

use crate::math::{DVec2, Vec2};

use super::irregular::{Irregular, irregular_disc, irregular_rectangle};
use super::refinement::{Divided, Refinement, divide};

/// Most times that the coarsest triangles of a sheet are divided.
pub const LEVELS_MAX: u32 = 3;

/// Outline of a sheet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Outline {
    /// A rectangle of this size, meters, with its bottom left corner at the origin.
    Rectangle([f64; 2]),
    /// A disc of this radius, meters, around the origin.
    Disc(f64),
}

impl Outline {
    /// The lowest and the highest material coordinates.
    pub fn bounds(&self) -> [DVec2; 2] {
        match *self {
            Outline::Rectangle(size_m) => [DVec2::ZERO, DVec2::from(size_m)],
            Outline::Disc(radius_m) => [DVec2::splat(-radius_m), DVec2::splat(radius_m)],
        }
    }
}

/// A sheet meshed at several levels. Level 0 is irregular and nearly equilateral; every triangle of a level is four
/// congruent ones of the next level, but along the circle of a disc, which the vertices of every level lie on.
///
/// Levels share their numbers: the vertices of a level are the first ones of the next level, and triangle t is divided
/// into 4 t to 4 t + 3. Vertices 0 to 3 of a rectangle are its corners: bottom left, bottom right, top left, top right.
#[derive(Clone, Debug, PartialEq)]
pub struct NestedSheet {
    outline: Outline,
    /// Material coordinates of all vertices of the finest level.
    points: Vec<DVec2>,
    /// For every vertex from `vertices[0]` on, the ends of the edge that it halves.
    parents: Vec<[u32; 2]>,
    /// Number of vertices of each level.
    vertices: Vec<usize>,
    /// Triangles of each level.
    triangles: Vec<Vec<[u32; 3]>>,
}

impl NestedSheet {
    /// A sheet of about `triangles` triangles at its finest level. It has [`LEVELS_MAX`] levels above level 0, or fewer
    /// if `triangles` is below 128, because level 0 has at least 2 triangles.
    pub fn new(outline: Outline, triangles: u64) -> NestedSheet {
        let levels = (triangles / 2).checked_ilog(4).unwrap_or(0).min(LEVELS_MAX);
        let divided = 1u64 << (2 * levels);
        let coarsest = ((triangles + divided / 2) / divided).max(2) as usize;
        let Irregular { points, triangles } = match outline {
            Outline::Rectangle(size_m) => irregular_rectangle(size_m, coarsest),
            Outline::Disc(radius_m) => irregular_disc(radius_m, coarsest),
        };
        let vertices = vec![points.len()];
        let mut sheet = NestedSheet { outline, vertices, points, parents: Vec::new(), triangles: vec![triangles] };
        (0..levels).for_each(|_| sheet.divide());
        sheet
    }

    /// True for a rectangle, false for a disc.
    pub fn is_rectangle(&self) -> bool {
        matches!(self.outline, Outline::Rectangle(_))
    }

    /// Number of the finest level; level 0 is the coarsest.
    pub fn finest(&self) -> usize {
        self.vertices.len() - 1
    }

    /// Number of vertices of a level.
    pub fn vertices(&self, level: usize) -> usize {
        self.vertices[level]
    }

    /// Triangles of a level, counter-clockwise.
    pub fn triangles(&self, level: usize) -> &[[u32; 3]] {
        &self.triangles[level]
    }

    /// The ends of the edge that a vertex halves; both belong to a coarser level than the vertex. None for vertices of
    /// level 0.
    pub fn parents(&self, vertex: u32) -> Option<[u32; 2]> {
        (vertex as usize).checked_sub(self.vertices[0]).map(|i| self.parents[i])
    }

    /// Material coordinates of a level's vertices: x = warp to the right, y = weft upwards, origin at the bottom left
    /// corner. Vertices on the boundary lie exactly on it.
    pub fn coordinates(&self, level: usize) -> Vec<Vec2> {
        self.points[..self.vertices[level]].iter().map(|p| p.as_vec2()).collect()
    }

    /// Vertices of a level on the side of a rectangle where coordinate `axis` is 0, or the size of the sheet if `far`,
    /// ascending along the side. None for a disc.
    pub fn side(&self, level: usize, axis: usize, far: bool) -> Vec<u32> {
        let Outline::Rectangle(size_m) = self.outline else { return Vec::new() };
        let place = if far { size_m[axis] } else { 0.0 };
        let on_side = |v: &u32| self.points[*v as usize][axis] == place;
        let mut side: Vec<u32> = (0..self.vertices[level] as u32).filter(on_side).collect();
        side.sort_by(|&a, &b| self.points[a as usize][1 - axis].total_cmp(&self.points[b as usize][1 - axis]));
        side
    }

    /// From a level to the finest one.
    pub fn refinement(&self, level: usize) -> Refinement {
        let first = self.vertices[level] as u32;
        let parts = 1 << (2 * (self.finest() - level));
        Refinement {
            copies: (0..first).collect(),
            middles: (first..self.points.len() as u32)
                .filter_map(|v| self.parents(v).map(|[a, b]| [v, a, b]))
                .collect(),
            triangles: (0..(self.triangles[level].len() * parts) as u32).collect(),
            parts,
        }
    }

    /// Adds a level.
    fn divide(&mut self) {
        let Divided { triangles, parents, on_boundary } = divide(self.points.len(), &self.triangles[self.finest()]);
        for &[p, q] in &parents {
            self.points.push((self.points[p as usize] + self.points[q as usize]) / 2.0);
        }
        self.parents.extend(parents);
        if let Outline::Disc(radius_m) = self.outline {
            for middle in on_boundary {
                let point = &mut self.points[middle as usize];
                *point *= radius_m / point.length();
            }
        }
        self.vertices.push(self.points.len());
        self.triangles.push(triangles);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    #[test]
    fn levels_are_nested() {
        let sheet = NestedSheet::new(Outline::Rectangle([3.0, 2.0]), 10_000);
        assert_eq!((sheet.finest(), sheet.triangles(0).len(), sheet.triangles(3).len()), (3, 156, 156 * 64));
        let uv = sheet.coordinates(3);
        for level in 0..3 {
            assert_eq!(sheet.coordinates(level), uv[..sheet.vertices(level)]);
            for v in sheet.vertices(level) as u32..sheet.vertices(level + 1) as u32 {
                let [a, b] = sheet.parents(v).unwrap();
                assert!(a < b && (b as usize) < sheet.vertices(level));
                assert!(uv[v as usize].distance((uv[a as usize] + uv[b as usize]) / 2.0) < 1e-6);
            }
            for (t, corners) in sheet.triangles(level).iter().enumerate() {
                let [a, b, c] = [0, 1, 2].map(|i| sheet.triangles(level + 1)[4 * t + i][i]);
                assert_eq!([a, b, c], *corners);
            }
        }
        assert_eq!(sheet.parents(0), None);
    }

    #[test]
    fn sides_are_complete_and_in_order() {
        let sheet = NestedSheet::new(Outline::Rectangle([3.0, 2.0]), 2_000);
        let uv = sheet.coordinates(3);
        let mut on_sides = 0;
        for (axis, far) in [(0, false), (0, true), (1, false), (1, true)] {
            let side = sheet.side(3, axis, far);
            assert!(side.windows(2).all(|w| uv[w[0] as usize][1 - axis] < uv[w[1] as usize][1 - axis]));
            let end = if far { [3.0, 2.0][axis] } else { 0.0 };
            assert!(side.iter().all(|&v| uv[v as usize][axis] == end));
            on_sides += side.len() - 1;
        }
        // Edges of one triangle only.
        let mut edges: HashMap<[u32; 2], u32> = HashMap::new();
        for [a, b, c] in sheet.triangles(3) {
            for [p, q] in [[a, b], [b, c], [c, a]] {
                *edges.entry([*p.min(q), *p.max(q)]).or_default() += 1;
            }
        }
        assert_eq!(on_sides, edges.values().filter(|&&n| n == 1).count());
    }

    #[test]
    fn the_number_of_triangles_is_met() {
        for triangles in [2, 7, 8, 31, 127, 128, 1_000, 1_234, 10_000, 77_777] {
            let sheet = NestedSheet::new(Outline::Rectangle([3.0, 2.0]), triangles);
            let divided = 1 << (2 * sheet.finest());
            let error = sheet.triangles(sheet.finest()).len() as i64 - triangles as i64;
            assert!(error.abs() <= divided / 2, "{triangles}: {error}");
        }
        assert_eq!(NestedSheet::new(Outline::Rectangle([3.0, 2.0]), 127).finest(), 2);
        assert_eq!(NestedSheet::new(Outline::Rectangle([3.0, 2.0]), 128).finest(), 3);
    }

    #[test]
    fn every_level_of_a_disc_is_round() {
        let sheet = NestedSheet::new(Outline::Disc(0.15), 4_000);
        let uv = sheet.coordinates(3);
        for level in 0..=3 {
            let mut edges: HashMap<[u32; 2], u32> = HashMap::new();
            for [a, b, c] in sheet.triangles(level) {
                for [p, q] in [[a, b], [b, c], [c, a]] {
                    *edges.entry([*p.min(q), *p.max(q)]).or_default() += 1;
                }
            }
            let rim = edges.iter().filter(|edge| *edge.1 == 1).flat_map(|edge| *edge.0);
            assert!(rim.clone().count() > 2 * 18 << level);
            rim.for_each(|v| assert!((uv[v as usize].length() / 0.15 - 1.0).abs() < 1e-6));
        }
        assert_eq!(sheet.triangles(3).len(), 4_032);
        assert!(sheet.side(3, 0, false).is_empty());
    }
}
