// Bending elements: one hinge record per interior edge; bend.rs explains the record, bend_cpu.rs the physics.
// needs element.wgsl

@group(0) @binding(0) var<storage, read> fabrics: array<FabricTable>;
@group(0) @binding(1) var<storage, read> elements: array<HingeElement>;
@group(0) @binding(2) var<storage, read> positions: array<Packed3>;
@group(0) @binding(3) var<storage, read> velocities: array<Packed3>;
@group(0) @binding(4) var<storage, read_write> records: array<vec4<f32>>;
@group(0) @binding(5) var<uniform> params: StepParams;

// Spacing of the curvature samples of the bending table, 1/m.
const CURVATURE_SPACING: f32 = 5.0;

// Altitude of a side, in mean altitudes of both at rest, below which k falls with its square.
const COLLAPSED: f32 = 0.02;

// Bending stiffness (N m) of one side at a curvature (1/m) and direction.
fn bending_stiffness(fabric: u32, curvature: f32, bias: f32) -> f32 {
    let along = min(abs(curvature) / CURVATURE_SPACING, 4.0);
    let column = min(u32(along), 3u);
    let a = along - f32(column);
    let row = min(u32(bias), 1u);
    let b = bias - f32(row);
    let at = row * 5u + column;
    let low = fabrics[fabric].bending[at] * (1.0 - a) + fabrics[fabric].bending[at + 1u] * a;
    let high = fabrics[fabric].bending[at + 5u] * (1.0 - a) + fabrics[fabric].bending[at + 6u] * a;
    return max(low * (1.0 - b) + high * b, 0.0);
}

// Which of the two fabrics of a hinge yields first; the first one if none does.
fn yields_first(of_sides: vec2<u32>) -> u32 {
    let one = fabrics[of_sides.x].yield_curvature;
    let other = fabrics[of_sides.y].yield_curvature;
    return select(of_sides.x, of_sides.y, other > 0.0 && (one <= 0.0 || other < one));
}

@compute @workgroup_size(WORKGROUP)
fn bend(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.count) {
        return;
    }
    let element = elements[i];
    let x0 = unpacked(positions[element.vertices.x]);
    let e = unpacked(positions[element.vertices.y]) - x0;
    let d0 = unpacked(positions[element.vertices.z]) - x0;
    let d1 = unpacked(positions[element.vertices.w]) - x0;
    let n0 = cross(e, d0);
    let n1 = cross(d1, e);
    let l2 = dot(e, e);
    let n0_2 = dot(n0, n0);
    let n1_2 = dot(n1, n1);
    // Dihedral angle and its gradient; both zero for a hinge with a degenerate triangle.
    var angle = 0.0;
    var g0 = vec3<f32>(0.0);
    var g1 = vec3<f32>(0.0);
    var g2 = vec3<f32>(0.0);
    var g3 = vec3<f32>(0.0);
    if (l2 > 0.0 && n0_2 > 0.0 && n1_2 > 0.0) {
        let length = sqrt(l2);
        angle = angle_of(dot(cross(n0, n1), e) / length, dot(n0, n1));
        g2 = n0 * (-length / n0_2);
        g3 = n1 * (-length / n1_2);
        let t0 = dot(d0, e) / l2;
        let t1 = dot(d1, e) / l2;
        g0 = -(g2 * (1.0 - t0) + g3 * (1.0 - t1));
        g1 = -(g2 * t0 + g3 * t1);
    }
    let curvature = element.curvature_from_angle * angle;
    let side0 = bending_stiffness(element.fabric.x, curvature, element.bias.x);
    let side1 = bending_stiffness(element.fabric.y, curvature, element.bias.y);
    var k = element.shape * min(side0, side1);
    if (element.plastic_curvature > 0.0) {
        let fabric = yields_first(element.fabric);
        let y = fabrics[fabric].yield_curvature;
        k *= y / (y + fabrics[fabric].weakening * element.plastic_curvature);
    }
    let floor_m = COLLAPSED / element.curvature_from_angle;
    let collapse = max(dot(g2, g2), dot(g3, g3)) * (floor_m * floor_m);
    if (collapse > 1.0) {
        k /= collapse;
    }
    let damping = 0.5 * (fabrics[element.fabric.x].damping_s + fabrics[element.fabric.y].damping_s);
    let rate = dot(g0, unpacked(velocities[element.vertices.x])) + dot(g1, unpacked(velocities[element.vertices.y]))
        + dot(g2, unpacked(velocities[element.vertices.z])) + dot(g3, unpacked(velocities[element.vertices.w]));
    let moment = k * (angle - element.rest_angle) + (params.ahead_s + damping) * k * rate;
    let h = params.step_s * (params.step_s + damping) * k;
    records[i * 4u] = vec4<f32>(g0, h);
    records[i * 4u + 1u] = vec4<f32>(g1, moment);
    records[i * 4u + 2u] = vec4<f32>(g2, 0.0);
    records[i * 4u + 3u] = vec4<f32>(g3, 0.0);
}
