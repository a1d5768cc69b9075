//! A net of quads, split in two, around the zeros of a function on a grid.

use std::collections::HashMap;

use super::field::Field;
use crate::math::DVec3;

/// Cells along the side of a block; blocks that the surface cannot pass through are skipped.
const BLOCK: i64 = 8;
/// Largest slope of the function.
const STEEPEST: f64 = 2.0;

/// Points and triangles of the net, faces outward. The points lie near the surface.
pub(super) fn net(field: &Field, bounds: [DVec3; 2], cell: f64) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let low = bounds[0] - DVec3::splat(1.5 * cell);
    let side = (bounds[1] - low) / cell + 1.5;
    let blocks = [side.x, side.y, side.z].map(|n| (n / BLOCK as f64).ceil() as i64);
    let at = |i: [i64; 3]| low + DVec3::new(i[0] as f64, i[1] as f64, i[2] as f64) * cell;
    let reach = STEEPEST * cell * BLOCK as f64 * 3f64.sqrt() / 2.0;
    let mut points = Vec::new();
    let mut of_edge: HashMap<([i64; 3], usize), u32> = HashMap::new();
    let mut crossed: Vec<([i64; 3], usize, bool)> = Vec::new();
    let n = BLOCK as usize + 1;
    let mut values = vec![0.0; n * n * n];
    for block in in_order(blocks) {
        let first = block.map(|b| b * BLOCK);
        if field(at(first) + DVec3::splat(cell * BLOCK as f64 / 2.0)).abs() > reach {
            continue;
        }
        let index = |i: [i64; 3]| (i[0] as usize * n + i[1] as usize) * n + i[2] as usize;
        for i in in_order([BLOCK + 1; 3]) {
            values[index(i)] = field(at([0, 1, 2].map(|k| first[k] + i[k])));
        }
        for i in in_order([BLOCK; 3]) {
            let corner = |bits: usize| [0, 1, 2].map(|k| i[k] + (bits >> k & 1) as i64);
            let value = |bits: usize| values[index(corner(bits))];
            let negative = (0..8).filter(|&bits| value(bits) < 0.0).count();
            if negative == 0 || negative == 8 {
                continue;
            }
            let cell = [0, 1, 2].map(|k| first[k] + i[k]);
            let signs: [bool; 8] = std::array::from_fn(|bits| value(bits) < 0.0);
            for sheet in sheets(signs) {
                // The mean of the points where the edges of the sheet cross the surface.
                let mut sum = DVec3::ZERO;
                for &edge in &sheet {
                    let [a, b] = EDGES[edge];
                    let [pa, pb] = [a, b].map(|bits| at([0, 1, 2].map(|k| first[k] + corner(bits)[k])));
                    sum += pa + (pb - pa) * (value(a) / (value(a) - value(b)));
                    of_edge.insert((cell, edge), points.len() as u32);
                }
                points.push(sum / sheet.len() as f64);
            }
            for axis in 0..3 {
                let (here, there) = (value(0), value(1 << axis));
                if (here < 0.0) != (there < 0.0) {
                    crossed.push((cell, axis, here < 0.0));
                }
            }
        }
    }
    let triangles = quads(&points, &of_edge, &crossed);
    (points, triangles)
}

/// Edges of a cell as corners, whose bits are x, y and z: four along each axis.
const EDGES: [[usize; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

fn edge_of(a: usize, b: usize) -> usize {
    EDGES.iter().position(|&edge| edge == [a.min(b), a.max(b)]).unwrap_or(0)
}

/// The crossed edges of a cell, sheet by sheet: a cell that the surface passes through twice has two points, so that
/// both sheets stay manifolds [Nielson 2004]. `negative` = at which corners the function is.
fn sheets(negative: [bool; 8]) -> Vec<Vec<usize>> {
    let mut sheet: [usize; 12] = std::array::from_fn(|edge| edge);
    let mut join = |a: usize, b: usize| {
        let (from, to) = (sheet[a].max(sheet[b]), sheet[a].min(sheet[b]));
        sheet.iter_mut().filter(|own| **own == from).for_each(|own| *own = to);
    };
    for axis in 0..3 {
        let (u, v) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
        for side in [0, 1 << axis] {
            let around = [side, side | u, side | u | v, side | v];
            let is_crossed = |i: usize| negative[around[i]] != negative[around[(i + 1) % 4]];
            let edge = |i: usize| edge_of(around[i], around[(i + 1) % 4]);
            let crossed: Vec<usize> = (0..4).filter(|&i| is_crossed(i)).collect();
            match crossed[..] {
                [a, b] => join(edge(a), edge(b)),
                // Both cells at such a face keep its negative corners apart.
                [_, _, _, _] => {
                    let first = if negative[around[0]] { 3 } else { 0 };
                    join(edge(first), edge((first + 1) % 4));
                    join(edge((first + 2) % 4), edge((first + 3) % 4));
                }
                _ => {}
            }
        }
    }
    let is_crossed = |edge: &usize| negative[EDGES[*edge][0]] != negative[EDGES[*edge][1]];
    let of_sheet = |own: usize| (0..12).filter(is_crossed).filter(|&edge| sheet[edge] == own).collect::<Vec<_>>();
    (0..12).map(of_sheet).filter(|edges| !edges.is_empty()).collect()
}

/// Four cells around every crossed edge of the grid make a quad, which its shorter diagonal splits.
fn quads(
    points: &[DVec3],
    of_edge: &HashMap<([i64; 3], usize), u32>,
    crossed: &[([i64; 3], usize, bool)],
) -> Vec<[u32; 3]> {
    let mut triangles = Vec::with_capacity(2 * crossed.len());
    for &(cell, axis, outward) in crossed {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let around = [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[du, dv]| {
            let mut other = cell;
            other[u] -= du as i64;
            other[v] -= dv as i64;
            let corner = du << u | dv << v;
            of_edge.get(&(other, edge_of(corner, corner | 1 << axis))).copied()
        });
        let [Some(a), Some(b), Some(c), Some(d)] = around else { continue };
        let [a, b, c, d] = if outward { [a, b, c, d] } else { [a, d, c, b] };
        let length = |s: u32, t: u32| points[s as usize].distance_squared(points[t as usize]);
        triangles.extend(match length(a, c) <= length(b, d) {
            true => [[a, b, c], [a, c, d]],
            false => [[a, b, d], [b, c, d]],
        });
    }
    triangles
}

/// All triples below `counts`, the last one fastest.
fn in_order(counts: [i64; 3]) -> impl Iterator<Item = [i64; 3]> {
    (0..counts[0]).flat_map(move |i| (0..counts[1]).flat_map(move |j| (0..counts[2]).map(move |k| [i, j, k])))
}
