//! Vertex order for locality by recursive bisection. It depends on the mesh alone, never on the number of ranks, so
//! that the row blocks of any number of ranks are ranges of one order.

use std::collections::BTreeSet;
use std::ops::Range;

use crate::math::Vec3;

use super::{TriangleMesh, pieces};

/// Number of blocks of space. Each block holds parts of all pieces that lie together; ranks share only the boundaries
/// of a few blocks.
const BLOCKS: usize = 32;
/// A part of a piece in a block has at least about 1/PARTS of all vertices, so that it does not disappear among the
/// others of a chunk.
const PARTS: usize = 120;

/// Position of the cut of a range of the order: near the middle, between chunks, after a number of chunks that is a
/// multiple of the highest power of two that leaves no sliver. The cut is up to a chunk and a half off the middle.
/// `range` must come from the same cuts of the whole order.
pub fn middle(range: &Range<usize>, chunk: usize) -> usize {
    if range.len() <= chunk.saturating_add(chunk / 2) {
        return range.start + range.len() / 2;
    }
    let chunks = range.len().div_ceil(chunk);
    let multiple = 1 << (chunks / 4).checked_ilog2().unwrap_or(0);
    range.start + chunks.div_ceil(2).next_multiple_of(multiple) * chunk
}

/// Returns `old_from_new` from recursive bisection at the median along the longest axis. Ties are broken by the old
/// index. O(n log n).
pub fn locality_order(coordinates: &[Vec3]) -> Vec<u32> {
    let mut points: Vec<Point> = coordinates.iter().copied().zip(0..).collect();
    bisect(&mut points, 0, 0..coordinates.len(), coordinates.len());
    points.into_iter().map(|p| p.1).collect()
}

/// Returns `old_from_new` of a mesh's vertices, cut at multiples of `chunk`. Space is cut into blocks, so that touching
/// pieces are near each other in the order. Within a block each piece is contiguous, because the preconditioner can
/// move parts of several pieces in one chunk only together.
pub fn vertex_order(mesh: &TriangleMesh, chunk: usize) -> Vec<u32> {
    let vertices = mesh.positions.len();
    let pieces = Pieces::of(mesh, chunk);
    let mut points: Vec<Point> = mesh.positions.iter().copied().zip(0..).collect();
    let mut blocks = vec![(0, vertices)];
    while let Some((start, end)) = blocks.pop() {
        let block = start..end;
        let points = &mut points[block.clone()];
        let cut = middle(&block, chunk);
        if block.len() * BLOCKS > vertices && block.len() > chunk && !pieces.single(points) {
            split(points, cut - block.start);
            let (low, high) = points.split_at(cut - block.start);
            if block.len() * PARTS / 2 > pieces.common(low, high) * vertices {
                blocks.extend([(start, cut), (cut, end)]);
                continue;
            }
        }
        pieces.sort(points);
        let mut start = block.start;
        for part in points.chunk_by_mut(|a, b| pieces.of[a.1 as usize] == pieces.of[b.1 as usize]) {
            part.iter_mut().for_each(|point| point.0 = pieces.coordinates[point.1 as usize]);
            bisect(part, start, block.clone(), chunk);
            start += part.len();
        }
    }
    points.into_iter().map(|p| p.1).collect()
}

/// Coordinates and old index.
type Point = (Vec3, u32);

/// Orders `points` by the cuts of `range`; they begin at `start` within it.
fn bisect(points: &mut [Point], start: usize, range: Range<usize>, chunk: usize) {
    if points.len() < 2 {
        return;
    }
    let cut = middle(&range, chunk);
    let low = cut.clamp(start, start + points.len()) - start;
    if low > 0 && low < points.len() {
        split(points, low);
    }
    let (lower, upper) = points.split_at_mut(low);
    bisect(lower, start, range.start..cut, chunk);
    bisect(upper, start + low, cut..range.end, chunk);
}

/// Moves the `low` points with the lowest coordinate along the longest axis to the front.
fn split(points: &mut [Point], low: usize) {
    let (lo, hi) = points.iter().fold((points[0].0, points[0].0), |(lo, hi), p| (lo.min(p.0), hi.max(p.0)));
    let extent = hi - lo;
    let axis = (0..3).fold(0, |longest, axis| if extent[axis] > extent[longest] { axis } else { longest });
    points.select_nth_unstable_by(low, |a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1)));
}

/// The pieces of a mesh that get an order of their own.
struct Pieces {
    /// For every vertex, a representative vertex of its piece. All pieces smaller than a chunk are merged into one.
    of: Vec<u32>,
    /// Material coordinates on a piece without seams, because folds in space do not bring its layers together there;
    /// positions otherwise.
    coordinates: Vec<Vec3>,
}

impl Pieces {
    const SMALL: u32 = u32::MAX;

    fn of(mesh: &TriangleMesh, chunk: usize) -> Pieces {
        let mut of = pieces(mesh.positions.len(), &mesh.triangles);
        let mut sizes = vec![0; of.len()];
        of.iter().for_each(|&piece| sizes[piece as usize] += 1);
        of.iter_mut().filter(|piece| sizes[**piece as usize] < chunk).for_each(|piece| *piece = Pieces::SMALL);
        let mut coordinates = vec![Vec3::NAN; of.len()];
        let mut seam = vec![false; of.len()];
        for (corners, uv) in mesh.triangles.iter().zip(&mesh.material_uv) {
            for (&v, uv) in corners.iter().zip(uv) {
                let slot = &mut coordinates[v as usize];
                if slot.is_nan() {
                    *slot = uv.extend(0.0);
                } else if *slot != uv.extend(0.0) && of[v as usize] != Pieces::SMALL {
                    seam[of[v as usize] as usize] = true;
                }
            }
        }
        for ((coordinates, position), &piece) in coordinates.iter_mut().zip(&mesh.positions).zip(&of) {
            if piece == Pieces::SMALL || seam[piece as usize] || coordinates.is_nan() {
                *coordinates = *position;
            }
        }
        Pieces { of, coordinates }
    }

    fn single(&self, points: &[Point]) -> bool {
        points.iter().all(|point| self.of[point.1 as usize] == self.of[points[0].1 as usize])
    }

    /// Number of pieces with points in both parts.
    fn common(&self, low: &[Point], high: &[Point]) -> usize {
        let set = |points: &[Point]| points.iter().map(|p| self.of[p.1 as usize]).collect::<BTreeSet<u32>>();
        set(low).intersection(&set(high)).count()
    }

    fn sort(&self, points: &mut [Point]) {
        points.sort_unstable_by_key(|point| (self.of[point.1 as usize], point.1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec2;

    #[test]
    fn halves_lie_on_either_side_of_the_median_and_ties_follow_the_index() {
        let line = [3.0, 1.0, 2.0, 0.0].map(|x| Vec3::new(x, 0.0, 0.0));
        assert_eq!(locality_order(&line), [3, 1, 2, 0]);
        assert_eq!(locality_order(&[Vec3::ONE; 5]), [0, 1, 2, 3, 4]);
        assert!(locality_order(&[]).is_empty());
    }

    /// Stacked sheets of `side` x `side` vertices, `gap` apart; sides have length 1.
    fn sheets(count: usize, side: usize, gap: f32) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        let place = |i: usize| i as f32 / (side - 1) as f32;
        for sheet in 0..count {
            let first = mesh.positions.len();
            for (j, i) in (0..side).flat_map(|j| (0..side).map(move |i| (j, i))) {
                mesh.positions.push(Vec3::new(place(i), place(j), sheet as f32 * gap));
                if i + 1 < side && j + 1 < side {
                    let v = (first + j * side + i) as u32;
                    let corners = [[v, v + 1, v + 1 + side as u32], [v, v + 1 + side as u32, v + side as u32]];
                    let uv = |v: u32| mesh_uv(v as usize - first, side);
                    mesh.triangles.extend(corners);
                    mesh.material_uv.extend(corners.map(|t| t.map(uv)));
                }
            }
        }
        mesh
    }

    fn mesh_uv(v: usize, side: usize) -> Vec2 {
        Vec2::new((v % side) as f32, (v / side) as f32) / (side - 1) as f32
    }

    #[test]
    fn chunks_hold_neighbors_of_one_piece_and_blocks_hold_all_pieces() {
        let (count, side, chunk) = (3, 64, 96);
        let mesh = sheets(count, side, 0.01);
        let order = vertex_order(&mesh, chunk);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.into_iter().eq(0..order.len() as u32));
        let sheet = |v: u32| v as usize / (side * side);
        let mixed = order.chunks(chunk).filter(|c| c.iter().any(|&v| sheet(v) != sheet(c[0]))).count();
        // A block is four chunks here and has three pieces, so two borders lie in its chunks.
        assert!(mixed <= 2 * BLOCKS, "{mixed} chunks of several sheets");
        for block in order.chunks(order.len() / 8) {
            assert!((0..count).all(|s| block.iter().any(|&v| sheet(v) == s)));
        }
        let extent = |chunk: &[u32]| {
            let of = |v: u32| mesh.positions[v as usize];
            let whole = |s: usize| chunk.iter().filter(move |&&v| sheet(v) == s).map(move |&v| of(v));
            (0..count)
                .map(|s| {
                    let (lo, hi) =
                        whole(s).fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), p| (lo.min(p), hi.max(p)));
                    (hi - lo).max_element()
                })
                .fold(0.0, f32::max)
        };
        // 96 vertices of one sheet are a square of 0.16.
        let widest = order.chunks(chunk).map(extent).fold(0.0, f32::max);
        assert!(widest < 0.5, "a chunk is {widest} wide");
    }

    #[test]
    fn a_folded_sheet_is_ordered_by_its_material_and_one_with_a_seam_by_space() {
        let side = 16;
        let mut mesh = sheets(1, side, 0.0);
        for (v, position) in mesh.positions.iter_mut().enumerate() {
            let uv = mesh_uv(v, side);
            *position = Vec3::new(uv.x.min(1.0 - uv.x), uv.y * 0.1, 0.0);
        }
        let sides = |order: &[u32]| {
            let half = |v: &u32| mesh_uv(*v as usize, side).x < 0.5;
            order[..side * side / 2].iter().filter(|v| half(v)).count().abs_diff(side * side / 4)
        };
        assert_eq!(sides(&vertex_order(&mesh, 1)), side * side / 4, "halves of the material");
        mesh.material_uv[0][0] = Vec2::new(7.0, 7.0);
        assert!(sides(&vertex_order(&mesh, 1)) < side, "both layers of the fold");
    }

    #[test]
    fn pieces_of_less_than_a_chunk_are_ordered_together() {
        // Far apart along x, in alternating order.
        let mut mesh = TriangleMesh::default();
        for k in 0..64usize {
            let at = Vec3::X * ((k * 37) % 64) as f32;
            let v = mesh.positions.len() as u32;
            mesh.positions.extend([at, at + Vec3::Y * 0.1, at + Vec3::Z * 0.1]);
            mesh.triangles.push([v, v + 1, v + 2]);
            mesh.material_uv.push([Vec2::ZERO, Vec2::X, Vec2::Y]);
        }
        let order = vertex_order(&mesh, 6);
        let x: Vec<f32> = order.iter().map(|&v| mesh.positions[v as usize].x).collect();
        assert!(x.chunks(12).zip(x.chunks(12).skip(1)).all(|(a, b)| {
            a.iter().copied().fold(f32::MIN, f32::max) <= b.iter().copied().fold(f32::MAX, f32::min)
        }));
    }

    #[test]
    fn cuts_fall_between_chunks() {
        assert_eq!(middle(&(0..97), 97), 48);
        assert_eq!(middle(&(90..97), 10), 93);
        // 128 chunks, 125 of them, 13, 2 with a short one.
        assert_eq!(middle(&(0..1280), 10), 640);
        assert_eq!(middle(&(0..1243), 10), 640);
        assert_eq!(middle(&(640..770), 10), 720);
        assert_eq!(middle(&(80..91), 10), 85);
        assert_eq!(middle(&(80..97), 10), 90);
    }
}
