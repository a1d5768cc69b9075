//! Check of the start state: pairs of triangles that cross or touch. It is exact for the given f32 coordinates.
//!
//! Touching is defined as in the continuous collision test of a step. It includes different vertices at one place (an
//! unwelded seam) and triangles that are folded flat onto each other at a common edge. Layers closer than the thickness
//! of the cloth are not reported.

use std::ops::Range;

use rayon::prelude::*;

use crate::math::Vec3;

use super::intersect::{edge_crosses_triangle, in_one_plane};
use super::{TriangleMesh, locality_order};

/// Triangles per leaf of a tree.
const LEAF: usize = 4;
/// Times the pairs of nodes are split before they are distributed to threads.
const ROUNDS: usize = 8;
/// Pairs of nodes per parallel batch. The search can end between two batches if the list is full. The number is fixed,
/// because the list must not depend on the number of threads.
const BATCH: usize = 64;
/// Limit of the listed pairs, because two coincident sheets have millions.
pub const MOST_PAIRS: usize = 10_000;

/// Triangles of one object, with its kind, which tells the tests that it does not need.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Group {
    /// Range of its triangles in the whole list.
    pub triangles: Range<usize>,
    /// Kind of the object.
    pub kind: GroupKind,
}

/// Kind of a group of triangles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroupKind {
    /// Cloth of any shape.
    Cloth,
    /// A plane sheet. It cannot cross itself.
    FlatCloth,
    /// An obstacle. It may cross itself and other obstacles.
    Obstacle,
}

/// The pairs of triangles that share a point, each pair ascending, in ascending order. The list has at most 10,000
/// pairs; the search ends when it is full, so a full list may be incomplete.
///
/// Common vertices of two triangles do not count as shared points.
pub fn crossings(positions: &[Vec3], triangles: &[[u32; 3]], groups: &[Group]) -> Vec<[u32; 2]> {
    let search = Search { positions, triangles };
    let boxes: Vec<Bounds> = groups.iter().map(|group| search.bounds(group.triangles.clone())).collect();
    let mut found = Vec::new();
    'search: for (i, one) in groups.iter().enumerate() {
        if one.kind == GroupKind::Cloth {
            let tree = search.tree(one.triangles.clone().map(|t| t as u32).collect());
            found.extend(search.pairs(&tree, &tree));
        }
        for (j, other) in groups.iter().enumerate().skip(i + 1) {
            if found.len() >= MOST_PAIRS {
                break 'search;
            }
            if one.kind == GroupKind::Obstacle && other.kind == GroupKind::Obstacle {
                continue;
            }
            // Most pairs of groups have disjoint boxes. For the others, only the overlap of the boxes is searched.
            let shared = boxes[i].shared(&boxes[j]);
            let parts = [one, other].map(|group| search.inside(group.triangles.clone(), &shared));
            if parts.iter().all(|part| !part.is_empty()) {
                let [one, other] = parts.map(|part| search.tree(part));
                found.extend(search.pairs(&one, &other));
            }
        }
    }
    found.sort_unstable();
    found.truncate(MOST_PAIRS);
    found
}

/// The first pair of triangles of a single mesh that share a point other than their common vertices.
pub fn first_intersection(mesh: &TriangleMesh) -> Option<[u32; 2]> {
    let whole = Group { triangles: 0..mesh.triangles.len(), kind: GroupKind::Cloth };
    crossings(&mesh.positions, &mesh.triangles, &[whole]).first().copied()
}

#[derive(Clone, Copy)]
struct Bounds {
    low: Vec3,
    high: Vec3,
}

impl Bounds {
    const NOTHING: Bounds = Bounds { low: Vec3::INFINITY, high: Vec3::NEG_INFINITY };

    fn of(points: impl IntoIterator<Item = Vec3>) -> Bounds {
        points
            .into_iter()
            .fold(Bounds::NOTHING, |bounds, p| Bounds { low: bounds.low.min(p), high: bounds.high.max(p) })
    }

    fn with(&self, other: &Bounds) -> Bounds {
        Bounds { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    fn shared(&self, other: &Bounds) -> Bounds {
        Bounds { low: self.low.max(other.low), high: self.high.min(other.high) }
    }

    fn overlaps(&self, other: &Bounds) -> bool {
        self.low.cmple(other.high).all() && other.low.cmple(self.high).all()
    }
}

/// A binary tree of boxes over triangles in locality order.
struct Tree {
    order: Vec<u32>,
    /// Box of every triangle of `order`.
    boxes: Vec<Bounds>,
    nodes: Vec<Node>,
}

/// A node over `order[start..start + len]`. The root is the last node.
struct Node {
    bounds: Bounds,
    start: usize,
    len: usize,
    children: Option<[usize; 2]>,
}

struct Search<'a> {
    positions: &'a [Vec3],
    triangles: &'a [[u32; 3]],
}

impl Search<'_> {
    fn corners(&self, t: u32) -> [Vec3; 3] {
        self.triangles[t as usize].map(|v| self.positions[v as usize])
    }

    fn bounds(&self, triangles: Range<usize>) -> Bounds {
        triangles.fold(Bounds::NOTHING, |bounds, t| bounds.with(&Bounds::of(self.corners(t as u32))))
    }

    fn inside(&self, triangles: Range<usize>, bounds: &Bounds) -> Vec<u32> {
        if !bounds.overlaps(bounds) {
            return Vec::new();
        }
        triangles.map(|t| t as u32).filter(|&t| Bounds::of(self.corners(t)).overlaps(bounds)).collect()
    }

    fn tree(&self, triangles: Vec<u32>) -> Tree {
        let centers: Vec<Vec3> = triangles.iter().map(|&t| self.corners(t).iter().sum::<Vec3>() / 3.0).collect();
        let order: Vec<u32> = locality_order(&centers).into_iter().map(|i| triangles[i as usize]).collect();
        let boxes: Vec<Bounds> = order.iter().map(|&t| Bounds::of(self.corners(t))).collect();
        let mut nodes = Vec::with_capacity(order.len());
        build(&boxes, 0, &mut nodes);
        Tree { order, boxes, nodes }
    }

    /// Pairs of one triangle from each tree. For the pairs within one tree, pass it twice.
    fn pairs(&self, one: &Tree, other: &Tree) -> Vec<[u32; 2]> {
        // The node pairs are split a few times and then searched in parallel. The result does not depend on the
        // threads.
        let mut parts = vec![(one.nodes.len() - 1, other.nodes.len() - 1)];
        for _ in 0..ROUNDS {
            let split = |pair| split(one, other, pair).unwrap_or([Some(pair), None, None]).into_iter().flatten();
            parts = parts.into_iter().flat_map(split).collect();
        }
        let search = |&part: &(usize, usize)| {
            let (mut found, mut open) = (Vec::new(), vec![part]);
            while let Some(pair) = open.pop().filter(|_| found.len() < MOST_PAIRS) {
                match split(one, other, pair) {
                    Some(parts) => open.extend(parts.into_iter().flatten()),
                    None => self.leaves(one, other, pair, &mut found),
                }
            }
            found
        };
        let mut found = Vec::new();
        for batch in parts.chunks(BATCH) {
            found.extend(batch.par_iter().map(search).collect::<Vec<_>>().concat());
            if found.len() >= MOST_PAIRS {
                break;
            }
        }
        found
    }

    /// Tests the triangles of two leaves.
    fn leaves(&self, one: &Tree, other: &Tree, (a, b): (usize, usize), found: &mut Vec<[u32; 2]>) {
        let (left, right) = (&one.nodes[a], &other.nodes[b]);
        let itself = std::ptr::eq(left, right);
        for s in left.start..left.start + left.len {
            for t in if itself { s + 1 } else { right.start }..right.start + right.len {
                if one.boxes[s].overlaps(&other.boxes[t]) {
                    self.test(one.order[s], other.order[t], found);
                }
            }
        }
    }

    fn test(&self, s: u32, t: u32, found: &mut Vec<[u32; 2]>) {
        let pair = [s.min(t), s.max(t)];
        if triangles_meet(pair.map(|t| self.triangles[t as usize]), pair.map(|t| self.corners(t))) {
            found.push(pair);
        }
    }
}

/// Splits a pair of nodes into smaller pairs: none where the boxes are disjoint. `None` for two leaves.
fn split(one: &Tree, other: &Tree, (a, b): (usize, usize)) -> Option<[Option<(usize, usize)>; 3]> {
    let (left, right) = (&one.nodes[a], &other.nodes[b]);
    if !left.bounds.overlaps(&right.bounds) {
        return Some([None; 3]);
    }
    match (left.children, right.children) {
        (None, None) => None,
        (Some([l, r]), _) if std::ptr::eq(left, right) => Some([Some((l, l)), Some((r, r)), Some((l, r))]),
        (Some([l, r]), _) if right.children.is_none() || left.len >= right.len => {
            Some([Some((l, b)), Some((r, b)), None])
        }
        (_, Some([l, r])) => Some([Some((a, l)), Some((a, r)), None]),
        (Some([l, r]), None) => Some([Some((l, b)), Some((r, b)), None]),
    }
}

/// Builds the tree over a range of boxes and returns its node. The depth is log2 of the number of triangles.
fn build(boxes: &[Bounds], start: usize, nodes: &mut Vec<Node>) -> usize {
    let len = boxes.len();
    let (bounds, children) = if len <= LEAF {
        (boxes.iter().fold(Bounds::NOTHING, |all, one| all.with(one)), None)
    } else {
        let pair = [build(&boxes[..len / 2], start, nodes), build(&boxes[len / 2..], start + len / 2, nodes)];
        (nodes[pair[0]].bounds.with(&nodes[pair[1]].bounds), Some(pair))
    };
    nodes.push(Node { bounds, start, len, children });
    nodes.len() - 1
}

/// True if the closed triangles share a point besides their common vertices. `corners` = vertex numbers.
pub fn triangles_meet(corners: [[u32; 3]; 2], [a, b]: [[Vec3; 3]; 2]) -> bool {
    let shared = corners[0].iter().filter(|v| corners[1].contains(v)).count();
    if shared == 2 {
        return folded_flat(corners, [a, b]);
    }
    let [in_a, in_b] = [[0, 1], [1, 0]].map(|[i, j]: [usize; 2]| corners[i].map(|v| corners[j].contains(&v)));
    if shared == 3 || on_one_side(a, b, in_b) || on_one_side(b, a, in_a) {
        return shared == 3;
    }
    // Edges that begin at a common vertex are skipped: they meet the other triangle there, and any further contact also
    // involves the edge opposite to the common vertex of one of the triangles.
    let meets = |edges: [Vec3; 3], known: [bool; 3], [a, b, c]: [Vec3; 3]| {
        let free = (0..3).map(|i| (i, (i + 1) % 3)).filter(|&(i, j)| !known[i] && !known[j]);
        free.into_iter().any(|(i, j)| edge_crosses_triangle(edges[i], edges[j], a, b, c))
    };
    meets(a, in_a, b) || meets(b, in_b, a)
}

/// True if two triangles with a common edge lie in one plane on the same side of the edge.
fn folded_flat(corners: [[u32; 3]; 2], positions: [[Vec3; 3]; 2]) -> bool {
    let edge: Vec<Vec3> = (0..3).filter(|&i| corners[1].contains(&corners[0][i])).map(|i| positions[0][i]).collect();
    let opposite = [0, 1].map(|t: usize| {
        let alone = (0..3).find(|&i| !corners[1 - t].contains(&corners[t][i]));
        alone.map_or(edge[0], |i| positions[t][i])
    });
    let along = edge[1].as_dvec3() - edge[0].as_dvec3();
    let [c, d] = opposite.map(|p| p.as_dvec3() - edge[0].as_dvec3());
    // Doubled area vectors. They point in opposite directions if the triangles lie flat side by side.
    along.cross(c).dot(along.cross(d)) > 0.0 && in_one_plane(edge[0], edge[1], opposite[0], opposite[1])
}

/// True if all corners of `other` that are not shared lie on one side of the plane of `face`, by more than rounding.
/// Then the triangles have only the shared corners in common.
fn on_one_side(face: [Vec3; 3], other: [Vec3; 3], shared: [bool; 3]) -> bool {
    /// Larger than the error of a few dozen roundings of relative size 2^-53.
    const ROUNDING: f64 = 1e-14;
    let origin = face[0].as_dvec3();
    let [u, v] = [face[1].as_dvec3() - origin, face[2].as_dvec3() - origin];
    let normal = u.cross(v);
    let (mut above, mut below) = (true, true);
    for (corner, _) in other.iter().zip(shared).filter(|(_, shared)| !shared) {
        let offset = corner.as_dvec3() - origin;
        let margin = ROUNDING * u.length() * v.length() * offset.length();
        let side = normal.dot(offset);
        above &= side > margin;
        below &= side < -margin;
    }
    above || below
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLOOR: [Vec3; 3] = [Vec3::ZERO, Vec3::new(4.0, 0.0, 0.0), Vec3::new(0.0, 4.0, 0.0)];

    fn meets(other: [[f32; 3]; 3]) -> bool {
        numbered([3, 4, 5], other)
    }

    /// `corners` = numbers of the other triangle's vertices; those of the floor are 0, 1, 2.
    fn numbered(corners: [u32; 3], other: [[f32; 3]; 3]) -> bool {
        let (floor, other) = ([0, 1, 2], other.map(Vec3::from));
        let found = triangles_meet([floor, corners], [FLOOR, other]);
        assert_eq!(triangles_meet([corners, floor], [other, FLOOR]), found);
        let turned = [corners[1], corners[2], corners[0]];
        assert_eq!(triangles_meet([floor, turned], [FLOOR, [other[1], other[2], other[0]]]), found);
        found
    }

    /// The first few of as many coincident sheets already give 10,000 pairs, so the search must end there. A full
    /// search would test 2 million pairs of sheets with 400 pairs of triangles each.
    #[test]
    fn a_full_list_ends_the_search() {
        let one = sheets(0.0);
        let (vertices, triangles) = (64, 98);
        let mut mesh = TriangleMesh::default();
        let mut groups = Vec::new();
        for sheet in 0..2000 {
            mesh.positions.extend(&one.positions[..vertices]);
            let start = mesh.triangles.len();
            let first = (sheet * vertices) as u32;
            mesh.triangles.extend(one.triangles[..triangles].iter().map(|t| t.map(|v| v + first)));
            groups.push(Group { triangles: start..mesh.triangles.len(), kind: GroupKind::FlatCloth });
        }
        let found = crossings(&mesh.positions, &mesh.triangles, &groups);
        assert_eq!(found.len(), MOST_PAIRS);
        assert!(found.is_sorted() && found[0] == [0, triangles as u32]);
        // The search must touch only the sheets that hold the listed pairs.
        let last = found.iter().map(|[_, t]| *t as usize / triangles).max().unwrap();
        assert!(last < 50, "sheet {last} was looked at");
        let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert_eq!(one_thread.install(|| crossings(&mesh.positions, &mesh.triangles, &groups)), found);
    }

    #[test]
    fn piercing_touching_and_missing() {
        assert!(meets([[1., 1., -1.], [1., 1., 1.], [9., 9., 0.5]]), "an edge through the inside");
        assert!(meets([[2., 2., -1.], [2., 2., 1.], [9., 9., 0.5]]), "an edge through an edge");
        assert!(meets([[1., 1., 0.], [1., 2., 1.], [2., 1., 1.]]), "a corner on the inside");
        assert!(!meets([[1., 1., 1e-30], [1., 2., 1.], [2., 1., 1.]]), "a corner just above");
        assert!(!meets([[3., 3., -1.], [3., 3., 1.], [9., 9., 0.5]]), "beside");
        assert!(meets([[0., 0., 0.], [1., -1., 1.], [1., -2., 1.]]), "two vertices at one place");
        assert!(!numbered([0, 3, 4], [[0., 0., 0.], [1., -1., 1.], [1., -2., 1.]]), "the same vertex");
        assert!(numbered([0, 3, 4], [[0., 0., 0.], [1., 1., 1.], [1., 1., -1.]]), "the same vertex, but through");
        assert!(numbered([0, 3, 4], [[0., 0., 0.], [1., 0., 0.], [1., -1., 1.]]), "the same vertex, along an edge");
        assert!(numbered([0, 3, 4], [[0., 0., 0.], [9., 0., 0.], [1., -1., 1.]]), "the same vertex, all along an edge");
    }

    #[test]
    fn coplanar_triangles() {
        assert!(meets([[1., 1., 0.], [1., 9., 0.], [9., 1., 0.]]), "overlapping");
        assert!(meets([[1., 1., 0.], [1., 2., 0.], [2., 1., 0.]]), "inside");
        assert!(meets([[-9., -9., 0.], [30., -9., 0.], [-9., 30., 0.]]), "around");
        let (beside, onto) = ([[4., 0., 0.], [4., 4., 0.], [0., 4., 0.]], [[4., 0., 0.], [1., 1., 0.], [0., 4., 0.]]);
        assert!(meets(beside), "an unwelded seam");
        assert!(!numbered([1, 3, 2], beside) && numbered([1, 3, 2], onto), "beside at a common edge, and folded flat");
        assert!(!numbered([1, 3, 2], onto.map(|[x, y, z]| [x, y, if x == y { 1e-30 } else { z }])), "nearly folded");
        assert!(numbered([2, 0, 1], [[0., 4., 0.], [0., 0., 0.], [4., 0., 0.]]), "the same triangle");
        assert!(!meets([[5., 5., 0.], [5., 6., 0.], [6., 5., 0.]]), "beside");
    }

    /// Two sheets of 7 x 7 cells. The second stands upright in or below the first.
    fn sheets(lift: f32) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for sheet in 0..2 {
            let start = mesh.positions.len() as u32;
            for (x, y) in (0..8).flat_map(|y| (0..8).map(move |x| (x as f32, y as f32))) {
                mesh.positions.push(if sheet == 0 { Vec3::new(x, y, 0.0) } else { Vec3::new(x + 0.1, 3.4, y + lift) });
            }
            for (x, y) in (0..7).flat_map(|y| (0..7).map(move |x| (x, y))) {
                let v = start + y * 8 + x;
                mesh.triangles.extend([[v, v + 1, v + 9], [v, v + 9, v + 8]]);
            }
        }
        mesh
    }

    #[test]
    fn all_groupings_find_what_brute_force_finds() {
        for lift in [-3.3, 0.5, -7.0] {
            let mesh = sheets(lift);
            let corners = |t: usize| mesh.triangles[t].map(|v| mesh.positions[v as usize]);
            let mut expected = Vec::new();
            for s in 0..98 {
                expected.extend(
                    (98..196)
                        .filter(|&t| triangles_meet([s, t].map(|t| mesh.triangles[t]), [corners(s), corners(t)]))
                        .map(|t| [s as u32, t as u32]),
                );
            }
            assert_eq!(expected.is_empty(), lift == 0.5);
            assert_eq!(first_intersection(&mesh), expected.first().copied());
            use GroupKind::{Cloth, FlatCloth, Obstacle};
            for kinds in [[Cloth, Cloth], [FlatCloth, FlatCloth], [FlatCloth, Obstacle], [Obstacle, Cloth]] {
                let groups = [(0..98, kinds[0]), (98..196, kinds[1])];
                let groups = groups.map(|(triangles, kind)| Group { triangles, kind });
                assert_eq!(crossings(&mesh.positions, &mesh.triangles, &groups), expected, "{kinds:?}");
            }
            let obstacles = [Group { triangles: 0..98, kind: Obstacle }, Group { triangles: 98..196, kind: Obstacle }];
            assert!(crossings(&mesh.positions, &mesh.triangles, &obstacles).is_empty());
        }
    }
}
