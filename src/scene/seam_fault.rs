//! Sentences about seams that do not make cloth of panels.

use crate::mesh::{Part, SewnFault, TriangleMesh};

use super::Cloth;

/// Where a triangle is, for messages about seams: a group or object of its file, or a cloth.
pub(super) fn panel_of(parts: &[Part], cloths: &[Cloth], triangle: u32) -> String {
    let part = parts.iter().find(|part| part.triangles.contains(&triangle));
    let named = part.map(|part| if part.group.is_empty() { &part.object } else { &part.group });
    let cloth = || cloths.iter().find(|cloth| cloth.triangles.contains(&triangle)).map(|cloth| &cloth.name);
    named.or_else(cloth).map_or_else(|| "the cloth".to_owned(), |name| format!("`{name}`"))
}

/// The sentence about seams that do not make cloth of panels. `vertex`: the number of a vertex in messages.
pub(super) fn fault_sentence(
    fault: SewnFault,
    mesh: &TriangleMesh,
    seam_of: impl Fn(u32) -> Option<String>,
    panel_of: impl Fn(u32) -> String,
    vertex: impl Fn(u32) -> u32,
) -> String {
    let seam = |[a, b]: [u32; 2]| {
        let name = seam_of(a).or_else(|| seam_of(b)).unwrap_or_default();
        format!("seam `{name}`")
    };
    let edge = |[a, b]: [u32; 2]| format!("the edge of vertices {} and {}", vertex(a), vertex(b));
    match fault {
        SewnFault::Collapsed { triangle, corners } => format!(
            "{} makes one vertex of vertices {} and {} of {}, which are corners of one triangle",
            seam(corners),
            vertex(corners[0]),
            vertex(corners[1]),
            panel_of(triangle)
        ),
        SewnFault::Manifold { edge: ends, triangle, count } => format!(
            "{} gives {} of {} {count} triangles; at most two may share an edge",
            seam(ends),
            edge(ends),
            panel_of(triangle)
        ),
        SewnFault::Orientation { edge: ends, triangles: [one, other] } => {
            let which = (0u32..).zip(&mesh.triangles).map(|(t, _)| t).find(|&t| t == other).map(&panel_of);
            format!(
                "the sides of {} run the wrong way: at {} of {} it would sew the outside to the inside of {}; turn one \
                 side around, or a panel over",
                seam(ends),
                edge(ends),
                panel_of(one),
                which.unwrap_or_default()
            )
        }
    }
}
