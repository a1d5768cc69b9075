//! Triangulates polygons of mesh files: by a fan where one fits, by ear clipping (`earcut`) for other concave polygons.
//!
//! A polygon that crosses itself or has no area is refused, because no triangulation matches what its author intended.

use crate::math::{DVec2, DVec3, Vec3};

use super::ParseFault;

/// Smallest doubled area over the squared longest edge of a triangle that a cut may produce.
const SMALLEST_SHAPE: f64 = 1e-6;
/// Up to this number of corners, every corner is tried as the center of a fan. The trials cost corners^2.
const FANS_TRIED_MOST: usize = 64;

/// Collects the faces of a file until all vertices are known.
#[derive(Default)]
pub(super) struct Faces {
    /// Vertex of every corner.
    pub corners: Vec<u32>,
    /// End of each face in `corners`.
    ends: Vec<u32>,
    /// Line of each face; 0 for formats without lines.
    lines: Vec<u32>,
}

/// Triangulated faces.
pub(super) struct Cut {
    /// Corners (indices into [`Faces::corners`]) of every triangle.
    pub triangles: Vec<[u32; 3]>,
    /// First triangle of each face, followed by the number of triangles.
    pub starts: Vec<u32>,
}

impl Faces {
    pub(super) fn len(&self) -> usize {
        self.ends.len()
    }

    /// Closes a face; its corners are those pushed since the previous one.
    pub(super) fn close(&mut self, line: u64) -> Result<(), String> {
        let end = u32::try_from(self.corners.len()).ok().filter(|&end| end < u32::MAX);
        self.ends.push(end.ok_or("more than 4294967294 corners of faces")?);
        self.lines.push(u32::try_from(line).unwrap_or(u32::MAX));
        Ok(())
    }

    /// Line of the face that a corner belongs to.
    pub(super) fn line_of(&self, corner: usize) -> u64 {
        self.lines[self.ends.partition_point(|&end| end as usize <= corner)].into()
    }

    /// Triangulates every face. Vertex indices are checked here, because faces can precede the vertices in a file.
    pub(super) fn cut(&self, positions: &[Vec3]) -> Result<Cut, ParseFault> {
        let mut cut = Cut { triangles: Vec::with_capacity(self.len()), starts: Vec::with_capacity(self.len() + 1) };
        let (mut start, mut points, mut pieces) = (0, Vec::new(), Vec::new());
        for (face, &end) in self.ends.iter().enumerate() {
            let fault = |what: String| match self.lines[face] {
                0 => ParseFault::whole(format!("face {}: {what}", face + 1)),
                line => ParseFault::at(line.into(), what),
            };
            cut.starts.push(cut.triangles.len() as u32);
            points.clear();
            for &vertex in &self.corners[start as usize..end as usize] {
                // Formats with lines count vertices from 1.
                let index = u64::from(vertex) + u64::from(self.lines[face] != 0);
                let missing = || fault(format!("vertex index {index}, but the file has only {}", positions.len()));
                points.push(positions.get(vertex as usize).ok_or_else(missing)?.as_dvec3());
            }
            pieces.clear();
            cut_polygon(&points, &mut pieces).map_err(|what| fault(what.into()))?;
            cut.triangles.extend(pieces.iter().map(|piece| piece.map(|corner| start + corner as u32)));
            start = end;
        }
        cut.starts.push(cut.triangles.len() as u32);
        Ok(cut)
    }
}

/// The triangles of faces that are given by their numbers of corners and by the vertices of the corners, one face after
/// the other.
///
/// # Errors
/// A face has too few corners, crosses itself or names a vertex that is not there; half a sentence.
pub(crate) fn triangles_of_faces(
    counts: &[usize],
    corners: Vec<u32>,
    positions: &[Vec3],
) -> Result<Vec<[u32; 3]>, String> {
    if let Some(face) = counts.iter().position(|&count| count < 3) {
        return Err(format!("face {}: {} corners, where there must be 3 or more", face + 1, counts[face]));
    }
    if counts.iter().fold(0usize, |sum, &count| sum.saturating_add(count)) != corners.len() {
        return Err(format!("its faces need another number of corners than the {} that there are", corners.len()));
    }
    let mut faces = Faces::default();
    let mut corners = corners.into_iter();
    for &count in counts {
        faces.corners.extend(corners.by_ref().take(count));
        faces.close(0)?;
    }
    let cut = faces.cut(positions).map_err(|fault| fault.what)?;
    Ok(cut.triangles.iter().map(|triangle| triangle.map(|corner| faces.corners[corner as usize])).collect())
}

/// Cuts one polygon into `points.len() - 2` triangles of its corners, all wound like the polygon.
fn cut_polygon(points: &[DVec3], pieces: &mut Vec<[usize; 3]>) -> Result<(), &'static str> {
    let corners = points.len();
    let fan = |tip: usize| (1..corners - 1).map(move |i| [0, i, i + 1].map(|corner| (tip + corner) % corners));
    if corners == 3 {
        pieces.extend(fan(0));
        return Ok(());
    }
    let flat = flattened(points);
    let area = |[a, b, c]: [usize; 3]| (flat[b] - flat[a]).perp_dot(flat[c] - flat[a]);
    // Above 0 for a triangle that is wound like the polygon and has an area.
    let shape = |piece: [usize; 3]| {
        let longest = (0..3).map(|i| flat[piece[i]].distance_squared(flat[piece[(i + 1) % 3]])).fold(0.0, f64::max);
        area(piece) - SMALLEST_SHAPE * longest
    };
    // A fan covers every point of the polygon once if its rays turn in one direction by less than a full turn.
    let fits = |tip: usize| {
        let angle = |[a, b, c]: [usize; 3]| (flat[b] - flat[a]).angle_to(flat[c] - flat[a]);
        fan(tip).all(|piece| shape(piece) > 0.0) && fan(tip).map(angle).sum::<f64>() < std::f64::consts::TAU
    };
    let tips = if corners <= FANS_TRIED_MOST { corners } else { 1 };
    if let Some(tip) = (0..tips).find(|&tip| fits(tip)) {
        pieces.extend(fan(tip));
        return Ok(());
    }
    let mut clipped: Vec<usize> = Vec::new();
    earcut::Earcut::new().earcut(flat.iter().map(|p| p.to_array()), &[], &mut clipped);
    pieces.extend(
        clipped.as_chunks::<3>().0.iter().map(|&[a, b, c]| if area([a, b, c]) < 0.0 { [a, c, b] } else { [a, b, c] }),
    );
    let whole: f64 = (0..corners).map(|i| flat[i].perp_dot(flat[(i + 1) % corners])).sum();
    let covered: f64 = pieces.iter().map(|&piece| area(piece)).sum();
    let good = pieces.len() == corners - 2 && pieces.iter().all(|&piece| shape(piece) > 0.0);
    if good && (covered - whole).abs() <= 1e-6 * whole {
        return Ok(());
    }
    pieces.clear();
    Err("the polygon crosses itself or has corners on one line, so it cannot be cut into triangles; \
         triangulate it when you export the mesh")
}

/// The corners projected to the plane of the polygon, counter-clockwise [Newell's normal].
fn flattened(points: &[DVec3]) -> Vec<DVec2> {
    let origin = points[0];
    let at = |i: usize| points[i % points.len()] - origin;
    let normal = (0..points.len()).map(|i| at(i).cross(at(i + 1))).sum::<DVec3>().normalize_or(DVec3::Z);
    let (u, v) = normal.any_orthonormal_pair();
    (0..points.len()).map(|i| DVec2::new(at(i).dot(u), at(i).dot(v))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pieces(points: &[[f64; 2]]) -> Result<Vec<[usize; 3]>, &'static str> {
        let mut pieces = Vec::new();
        // In a tilted plane, so that the normal matters.
        let points: Vec<DVec3> = points.iter().map(|&[x, y]| DVec3::new(x, y, 2.0 * x - y)).collect();
        cut_polygon(&points, &mut pieces).map(|()| pieces)
    }

    /// Area of the pieces in the xy plane. Every piece must be counter-clockwise.
    fn area(points: &[[f64; 2]]) -> f64 {
        let pieces = pieces(points).unwrap();
        let at = |i: usize| DVec2::from(points[i]);
        let areas: Vec<f64> = pieces.iter().map(|&[a, b, c]| (at(b) - at(a)).perp_dot(at(c) - at(a)) / 2.0).collect();
        assert!(areas.iter().all(|&area| area > 0.0), "{pieces:?}");
        areas.iter().sum()
    }

    #[test]
    fn convex_polygons_are_fans_about_the_first_corner() {
        assert_eq!(pieces(&[[0., 0.], [1., 0.], [1., 1.], [0., 1.]]).unwrap(), [[0, 1, 2], [0, 2, 3]]);
        let hexagon: Vec<[f64; 2]> = (0..6).map(|i| DVec2::from_angle(f64::from(i)).to_array()).collect();
        assert_eq!(pieces(&hexagon).unwrap(), [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]);
    }

    #[test]
    fn notches_are_not_covered() {
        let u = [[0., 0.], [5., 0.], [5., 4.], [4., 4.], [4., 1.], [1., 1.], [1., 4.], [0., 4.]];
        assert!((area(&u) - 11.0).abs() < 1e-12);
        let arrow = [[0., 0.], [4., 0.], [1., 1.], [0., 4.]];
        assert!((area(&arrow) - 4.0).abs() < 1e-12);
        let (mut turned, mut around) = (arrow, u);
        for _ in 0..4 {
            turned.rotate_left(1);
            around.rotate_left(2);
            assert!((area(&turned) - 4.0).abs() < 1e-12 && (area(&around) - 11.0).abs() < 1e-12);
        }
    }

    #[test]
    fn a_corner_on_a_straight_side_keeps_its_vertex() {
        let house = [[0., 0.], [1., 0.], [2., 0.], [2., 2.], [0., 2.]];
        assert!((area(&house) - 4.0).abs() < 1e-12);
    }

    #[test]
    fn what_crosses_itself_is_refused() {
        assert!(pieces(&[[0., 0.], [1., 1.], [1., 0.], [0., 1.]]).is_err(), "a bow");
        let star: Vec<[f64; 2]> = (0..5).map(|i| DVec2::from_angle(f64::from(i) * 2.0 * 1.256637).to_array()).collect();
        assert!(pieces(&star).is_err(), "a pentagram");
        assert!(pieces(&[[0., 0.], [1., 0.], [2., 0.], [3., 0.]]).is_err(), "a line");
    }
}
