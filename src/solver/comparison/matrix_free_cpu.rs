//! Loops of the product without a stored matrix (`matrix_free`), which has no shader.

use super::element_matrix::{KEPT_CONTACT, KEPT_TRIANGLE};
use crate::assembly::contact_system::NO_SLOT;
use crate::forces::{
    CONTACT_RECORD_FLOATS, ContactElement, HINGE_RECORD_FLOATS, HingeElement, TRIANGLE_RECORD_FLOATS, TriangleElement,
};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;

/// Elastic elements of the gather.
pub(super) struct ElementInputs<'a> {
    pub triangle_offsets: &'a [u32],
    pub triangle_entries: &'a [u32],
    pub hinge_offsets: &'a [u32],
    pub hinge_entries: &'a [u32],
    pub triangles: &'a [TriangleElement],
    pub hinges: &'a [HingeElement],
    pub triangle_records: &'a [f32],
    pub hinge_records: &'a [f32],
    pub masses: &'a [f32],
}

/// Contacts of the gather; lists of touched rows.
pub(super) struct ContactInputs<'a> {
    pub slots: &'a [u32],
    pub offsets: &'a [u32],
    pub entries: &'a [u32],
    pub records: &'a [f32],
    pub elements: &'a [ContactElement],
}

#[inline(always)]
fn at(values: &[f32], row: usize) -> Vec3 {
    Vec3::new(values[row * 3], values[row * 3 + 1], values[row * 3 + 2])
}

/// A, B, C of every triangle: the product of its block row for corner a with x is u_a A + v_a B + C. With
/// w_u = sum(u_b x_b), w_v = sum(v_b x_b), and x_u, x_v, stiffnesses and stresses of the record:
/// A = x_u (warp x_u.w_u + cross x_v.w_v) + x_v shear (x_u.w_v + x_v.w_u) + S_uu w_u + S_uv w_v; B is A with u and v
/// exchanged; C = air.
/// Bytes per triangle: 48 + 96 read, 36 written.
pub(super) fn triangle_terms(
    cpu: &CpuExecutor,
    triangles: &[TriangleElement],
    records: &[f32],
    x: &[f32],
    terms: &mut [f32],
) {
    cpu.for_ranges_mut(terms, KEPT_TRIANGLE, 64, |range, terms| {
        let records = records[range.start * TRIANGLE_RECORD_FLOATS..].as_chunks::<TRIANGLE_RECORD_FLOATS>().0;
        for ((triangle, r), term) in triangles[range].iter().zip(records).zip(terms.as_chunks_mut::<KEPT_TRIANGLE>().0)
        {
            let corners = triangle.vertices.map(|v| at(x, v as usize));
            let (d1, d2) = (corners[1] - corners[0], corners[2] - corners[0]);
            let ([u1, u2], [v1, v2]) = (triangle.weights_u, triangle.weights_v);
            let (wu, wv) = (d1 * u1 + d2 * u2, d1 * v1 + d2 * v2);
            let (xu, xv) = (Vec3::new(r[0], r[1], r[2]), Vec3::new(r[4], r[5], r[6]));
            let (warp, cross, weft, shear) = (r[3], r[7], r[8], r[9]);
            let (suu, suv, svv) = (r[10], r[11], r[12]);
            let (along_u, along_v) = (xu.dot(wu), xv.dot(wv));
            let sheared = shear * (xu.dot(wv) + xv.dot(wu));
            let a = xu * (warp * along_u + cross * along_v) + xv * sheared + wu * suu + wv * suv;
            let b = xv * (weft * along_v + cross * along_u) + xu * sheared + wv * svv + wu * suv;
            let normal = xu.cross(xv);
            let n = normal * (1.0 / normal.length().max(1e-30));
            let sum = corners[0] + corners[1] + corners[2];
            let c = n * ((r[13] - r[14]) * n.dot(sum)) + sum * r[14];
            *term = [a.x, a.y, a.z, b.x, b.y, b.z, c.x, c.y, c.z];
        }
    });
}

/// h k sum(g_b . (x_b - x_0)) of every hinge, with g of its record: the g_b sum to zero. Bytes per hinge: 48 + 64
/// read, 4 written.
pub(super) fn hinge_terms(cpu: &CpuExecutor, hinges: &[HingeElement], records: &[f32], x: &[f32], terms: &mut [f32]) {
    cpu.for_ranges_mut(terms, 1, 64, |range, terms| {
        let records = records[range.start * HINGE_RECORD_FLOATS..].as_chunks::<HINGE_RECORD_FLOATS>().0;
        for ((hinge, r), term) in hinges[range].iter().zip(records).zip(terms) {
            let (mut sum, first) = (0.0, at(x, hinge.vertices[0] as usize));
            for (corner, &v) in hinge.vertices.iter().enumerate().skip(1) {
                let g = Vec3::new(r[corner * 4], r[corner * 4 + 1], r[corner * 4 + 2]);
                sum += g.dot(at(x, v as usize) - first);
            }
            *term = sum * r[3];
        }
    });
}

/// beta t + (alpha - beta) n (n.t) with t = sum(w_b x_b) of every contact. Vertices beyond the end of x belong to
/// obstacles and have no column. Bytes per contact: 64 + 48 read, 12 written.
pub(super) fn contact_terms(
    cpu: &CpuExecutor,
    contacts: &[ContactElement],
    records: &[f32],
    x: &[f32],
    terms: &mut [f32],
) {
    cpu.for_ranges_mut(terms, KEPT_CONTACT, 64, |range, terms| {
        let records = records[range.start * CONTACT_RECORD_FLOATS..].as_chunks::<CONTACT_RECORD_FLOATS>().0;
        for ((contact, r), term) in contacts[range].iter().zip(records).zip(terms.as_chunks_mut::<KEPT_CONTACT>().0) {
            let mut t = Vec3::ZERO;
            for (&v, &weight) in contact.vertices.iter().zip(&r[..4]) {
                if (v as usize) < x.len() / 3 {
                    t += at(x, v as usize) * weight;
                }
            }
            let (n, alpha, beta) = (Vec3::new(r[4], r[5], r[6]), r[7], r[8]);
            *term = (t * beta + n * ((alpha - beta) * n.dot(t))).to_array();
        }
    });
}

/// Product of every own row: its mass, triangles, hinges and contacts, each kind in ascending element order. `terms`:
/// those of triangles, hinges and contacts. `own`: x of the own rows.
pub(super) fn gather(
    cpu: &CpuExecutor,
    elements: &ElementInputs<'_>,
    contacts: Option<&ContactInputs<'_>>,
    terms: (&[f32], &[f32], &[f32]),
    own: &[f32],
    y: &mut [f32],
) {
    let (triangle_terms, hinge_terms, contact_terms) = terms;
    let triangle_terms = triangle_terms.as_chunks::<KEPT_TRIANGLE>().0;
    let records = elements.hinge_records.as_chunks::<HINGE_RECORD_FLOATS>().0;
    let list = |offsets: &[u32], row: usize| offsets[row] as usize..offsets[row + 1] as usize;
    cpu.for_ranges_mut(y, 3, 64, |range, y| {
        for (row, y) in range.zip(y.as_chunks_mut::<3>().0) {
            let mut sum = at(own, row) * elements.masses[row];
            for &entry in &elements.triangle_entries[list(elements.triangle_offsets, row)] {
                let e = (entry >> 2) as usize;
                let [u, v] = elements.triangles[e].corner_weights()[(entry & 3) as usize];
                let [ax, ay, az, bx, by, bz, cx, cy, cz] = triangle_terms[e];
                sum += Vec3::new(ax, ay, az) * u + Vec3::new(bx, by, bz) * v + Vec3::new(cx, cy, cz);
            }
            for &entry in &elements.hinge_entries[list(elements.hinge_offsets, row)] {
                let (e, corner) = ((entry >> 2) as usize, (entry & 3) as usize * 4);
                let r = &records[e];
                sum += Vec3::new(r[corner], r[corner + 1], r[corner + 2]) * hinge_terms[e];
            }
            if let Some(contacts) = contacts
                && contacts.slots[row] != NO_SLOT
            {
                for &entry in &contacts.entries[list(contacts.offsets, contacts.slots[row] as usize)] {
                    let (e, corner) = ((entry >> 2) as usize, (entry & 3) as usize);
                    sum += at(contact_terms, e) * contacts.records[e * CONTACT_RECORD_FLOATS + corner];
                }
            }
            *y = sum.to_array();
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two vertices, the second one an obstacle's, normal x, alpha 4, beta 1, weights 1 and -1.
    #[test]
    fn a_contact_with_an_obstacle_by_hand() {
        let record = [1.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 4.0, 1.0, 8.0, 0.0, 2.0];
        let contact = ContactElement {
            vertices: [0, 2, u32::MAX, u32::MAX],
            weights: [1.0, -1.0, 0.0, 0.0],
            normal: [1.0, 0.0, 0.0],
            distance_m: 0.0,
            thickness_m: 0.0,
            stiffness_n_m: 0.0,
            friction: 0.0,
            kind: 0,
        };
        let (cpu, x) = (CpuExecutor::new(1), [1.0, 2.0, 3.0, 9.0, 9.0, 9.0]);
        let mut terms = [0.0; 3];
        contact_terms(&cpu, &[contact], &record, &x, &mut terms);
        assert_eq!(terms, [4.0, 2.0, 3.0]);
        let elements = ElementInputs {
            triangle_offsets: &[0, 0, 0],
            triangle_entries: &[],
            hinge_offsets: &[0, 0, 0],
            hinge_entries: &[],
            triangles: &[],
            hinges: &[],
            triangle_records: &[],
            hinge_records: &[],
            masses: &[2.0, 3.0],
        };
        let contacts = ContactInputs {
            slots: &[0, NO_SLOT],
            offsets: &[0, 1],
            entries: &[0],
            records: &record,
            elements: &[contact],
        };
        let mut y = [1.0; 6];
        gather(&cpu, &elements, Some(&contacts), (&[], &[], &terms), &x, &mut y);
        assert_eq!(y, [6.0, 6.0, 9.0, 27.0, 27.0, 27.0]);
    }

    /// Four vertices; h k = 2, gradients along the axes.
    #[test]
    fn a_hinge_by_hand() {
        let record = [1.0, 0.0, 0.0, 2.0, 0.0, 1.0, 0.0, 9.0, 0.0, 0.0, 1.0, 0.0, -1.0, -1.0, -1.0, 0.0];
        let hinge = HingeElement {
            vertices: [0, 1, 2, 3],
            shape: 0.0,
            curvature_from_angle: 0.0,
            rest_angle: 0.0,
            plastic_curvature: 0.0,
            bias: [0.0; 2],
            fabric: [0; 2],
        };
        let x: Vec<f32> = (1..=12).map(|v| v as f32).collect();
        let mut terms = [0.0];
        hinge_terms(&CpuExecutor::new(1), &[hinge], &record, &x, &mut terms);
        // 2 (1 + 5 + 9 - 10 - 11 - 12)
        assert_eq!(terms, [-36.0]);
    }
}
