// Creases: the return map of every hinge; crease.rs explains it.
// needs element.wgsl

struct CreaseParams {
    count: u32,
    padding: u32,
}

@group(0) @binding(0) var<storage, read> fabrics: array<FabricTable>;
@group(0) @binding(1) var<storage, read> positions: array<Packed3>;
@group(0) @binding(2) var<storage, read_write> elements: array<HingeElement>;
@group(0) @binding(3) var<storage, read_write> damage: array<f32>;
@group(0) @binding(4) var<uniform> params: CreaseParams;

@compute @workgroup_size(WORKGROUP)
fn crease(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.count) {
        return;
    }
    let element = elements[i];
    let one = fabrics[element.fabric.x].yield_curvature;
    let other = fabrics[element.fabric.y].yield_curvature;
    let fabric = select(element.fabric.x, element.fabric.y, other > 0.0 && (one <= 0.0 || other < one));
    if (fabrics[fabric].yield_curvature <= 0.0) {
        return;
    }
    let x0 = unpacked(positions[element.vertices.x]);
    let e = unpacked(positions[element.vertices.y]) - x0;
    let d0 = unpacked(positions[element.vertices.z]) - x0;
    let d1 = unpacked(positions[element.vertices.w]) - x0;
    let n0 = cross(e, d0);
    let n1 = cross(d1, e);
    let l2 = dot(e, e);
    // The angle of a hinge with a degenerate triangle is zero, as in bend.wgsl.
    var angle = 0.0;
    if (l2 > 0.0 && dot(n0, n0) > 0.0 && dot(n1, n1) > 0.0) {
        angle = angle_of(dot(cross(n0, n1), e) / sqrt(l2), dot(n0, n1));
    }
    let curvature = element.curvature_from_angle * (angle - element.rest_angle);
    let hardening = fabrics[fabric].hardening;
    let excess = abs(curvature) - (fabrics[fabric].yield_curvature + hardening * element.plastic_curvature);
    if (excess > 0.0) {
        let change = excess / (1.0 + hardening);
        elements[i].rest_angle += select(change, -change, curvature < 0.0) / element.curvature_from_angle;
        elements[i].plastic_curvature += change;
        damage[i] = elements[i].plastic_curvature / fabrics[fabric].yield_curvature;
    }
}
