//! Flips triangles that are wound against their neighbors, if a consistent winding exists.

use super::MeshFault;

/// Flips triangles until any two that share an edge traverse it in opposite directions. Of each connected piece the
/// smaller part is flipped. Returns which triangles are flipped. Every edge must have at most two triangles.
///
/// # Errors
/// The surface is not orientable, like a Moebius strip.
pub(super) fn turn_over(triangles: &[[u32; 3]]) -> Result<Vec<bool>, MeshFault> {
    // Each edge with its triangle and the direction in which the triangle traverses it.
    let mut edges: Vec<([u32; 2], u32, bool)> = (0u32..)
        .zip(triangles)
        .flat_map(|(t, &[a, b, c])| {
            [(a, b), (b, c), (c, a)].map(|(from, to)| ([from.min(to), from.max(to)], t, from > to))
        })
        .collect();
    edges.sort_unstable();
    let mut neighbors = vec![[(u32::MAX, false); 3]; triangles.len()];
    let mut count = vec![0usize; triangles.len()];
    for pair in edges.chunk_by(|one, other| one.0 == other.0) {
        if let [one, other] = pair {
            let same_way = one.2 == other.2;
            for (t, neighbor) in [(one.1, other.1), (other.1, one.1)] {
                neighbors[t as usize][count[t as usize]] = (neighbor, same_way);
                count[t as usize] += 1;
            }
        }
    }
    let (mut turned, mut seen) = (vec![false; triangles.len()], vec![false; triangles.len()]);
    for start in 0..triangles.len() {
        if std::mem::replace(&mut seen[start], true) {
            continue;
        }
        let (mut piece, mut next) = (vec![start], 0);
        while next < piece.len() {
            let t = piece[next];
            next += 1;
            for &(neighbor, same_way) in &neighbors[t][..count[t]] {
                let wanted = turned[t] != same_way;
                let neighbor = neighbor as usize;
                if !seen[neighbor] {
                    (seen[neighbor], turned[neighbor]) = (true, wanted);
                    piece.push(neighbor);
                } else if turned[neighbor] != wanted {
                    return Err(MeshFault::OneSided { triangles: [t + 1, neighbor + 1] });
                }
            }
        }
        if 2 * piece.iter().filter(|&&t| turned[t]).count() > piece.len() {
            piece.iter().for_each(|&t| turned[t] = !turned[t]);
        }
    }
    Ok(turned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smaller_part_of_each_piece_is_turned() {
        // A strip of four triangles with mixed winding, and two separate ones that disagree.
        let triangles = [[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 5, 4], [9, 8, 7], [7, 6, 8]];
        let turned = turn_over(&triangles).unwrap();
        let fixed: Vec<[u32; 3]> =
            triangles.iter().zip(&turned).map(|(&[a, b, c], &t)| if t { [a, c, b] } else { [a, b, c] }).collect();
        assert!(turned.iter().any(|&t| t) && turned[..4].iter().filter(|&&t| t).count() <= 2);
        assert_eq!(turn_over(&fixed).unwrap(), [false; 6]);
    }

    #[test]
    fn a_moebius_strip_has_one_side() {
        let strip = |twisted: bool| {
            let at = |column: u32, row: u32| match (column, twisted) {
                (6, true) => 1 - row,
                (6, false) => row,
                _ => 2 * column + row,
            };
            let cell = |c: u32| [[at(c, 0), at(c + 1, 0), at(c, 1)], [at(c + 1, 0), at(c + 1, 1), at(c, 1)]];
            (0..6).flat_map(cell).collect::<Vec<_>>()
        };
        assert_eq!(turn_over(&strip(false)).unwrap(), [false; 12]);
        assert!(matches!(turn_over(&strip(true)), Err(MeshFault::OneSided { .. })));
    }
}
