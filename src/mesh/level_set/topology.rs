//! Which triangles of a surface hang together, and whether it is a manifold.

use std::collections::HashMap;

use crate::math::DVec3;

/// True if every edge has at most two triangles that run along it in opposite directions, and the triangles around
/// every vertex are one fan.
pub(super) fn is_manifold(vertices: usize, triangles: &[[u32; 3]]) -> bool {
    let mut directed: HashMap<[u32; 2], u32> = HashMap::with_capacity(3 * triangles.len());
    for &[a, b, c] in triangles {
        for edge in [[a, b], [b, c], [c, a]] {
            if directed.insert(edge, 0).is_some() {
                return false;
            }
        }
    }
    // A vertex with one fan has at most one border edge that leaves it and, walked around, all of its triangles.
    let mut of_vertex: Vec<Vec<[u32; 2]>> = vec![Vec::new(); vertices];
    for &[a, b, c] in triangles {
        for [v, from, to] in [[a, b, c], [b, c, a], [c, a, b]] {
            of_vertex[v as usize].push([from, to]);
        }
    }
    of_vertex.iter().all(|fan| {
        let starts = fan.iter().filter(|[from, _]| !fan.iter().any(|[_, to]| to == from));
        let mut starts = starts.map(|[from, _]| *from);
        let Some(first) = starts.next().or(fan.first().map(|[from, _]| *from)) else { return true };
        if starts.next().is_some() {
            return false;
        }
        let (mut at, mut count) = (first, 0);
        while let Some([_, to]) = fan.iter().find(|[from, _]| *from == at) {
            (at, count) = (*to, count + 1);
            if at == first {
                break;
            }
        }
        count == fan.len()
    })
}

/// The triangles of the connected piece with most of them.
pub(super) fn largest_piece(triangles: Vec<[u32; 3]>) -> Vec<[u32; 3]> {
    let vertices = triangles.iter().flatten().max().map_or(0, |&v| v as usize + 1);
    let mut root: Vec<u32> = (0..vertices as u32).collect();
    fn find(root: &mut [u32], mut v: u32) -> u32 {
        while root[v as usize] != v {
            root[v as usize] = root[root[v as usize] as usize];
            v = root[v as usize];
        }
        v
    }
    for &[a, b, c] in &triangles {
        for (s, t) in [(a, b), (b, c)] {
            let (s, t) = (find(&mut root, s), find(&mut root, t));
            root[s.max(t) as usize] = s.min(t);
        }
    }
    let mut count = vec![0usize; vertices];
    triangles.iter().for_each(|corners| count[find(&mut root, corners[0]) as usize] += 1);
    let most = count.iter().copied().max().unwrap_or(0);
    let chosen = count.iter().position(|&n| n == most).unwrap_or(0) as u32;
    triangles.into_iter().filter(|corners| find(&mut root, corners[0]) == chosen).collect()
}

/// Only the points that triangles name, in their order.
pub(super) fn compact(points: Vec<DVec3>, mut triangles: Vec<[u32; 3]>) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let mut used = vec![false; points.len()];
    triangles.iter().flatten().for_each(|&v| used[v as usize] = true);
    let mut number = vec![0u32; points.len()];
    let mut kept = Vec::new();
    for (v, point) in points.into_iter().enumerate().filter(|&(v, _)| used[v]) {
        number[v] = kept.len() as u32;
        kept.push(point);
    }
    triangles.iter_mut().flatten().for_each(|v| *v = number[*v as usize]);
    (kept, triangles)
}
