//! Named cases of the elementary tests, each swept around touching: a gap of a few ulps is a miss, touching and a few
//! ulps beyond are hits. Static tests of closest points and proximity beside them.

use loomtree::collision::elementary::CandidateKind::{EdgeEdge, VertexFace};
use loomtree::collision::elementary::{
    CandidateKind, DecidedBy, Filtered, ccd, ccd_fallback, ccd_filter, closest_points, proximity,
};
use loomtree::math::Vec3;
use support::seeded::Seeded;

const FACE: [[f32; 3]; 3] = [[0., 0., 0.], [1., 0., 0.], [0., 1., 0.]];
/// Gaps around touching. Around 1, f32 resolves 6e-8; around 0 much less.
const EPSILONS: [f32; 4] = [1e-30, 1e-12, 1.2e-7, 1e-3];

fn points(x: [[f32; 3]; 4]) -> [Vec3; 4] {
    x.map(Vec3::from)
}

/// Stencils that are the same question, and the same with time reversed last.
fn same_questions(kind: CandidateKind) -> Vec<[usize; 4]> {
    match kind {
        VertexFace => vec![[0, 1, 2, 3], [0, 2, 3, 1], [0, 3, 2, 1], [0, 2, 1, 3]],
        EdgeEdge => vec![[0, 1, 2, 3], [1, 0, 2, 3], [0, 1, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]],
    }
}

/// The answer, checked against all orders of the vertices, powers of two of the size, and time reversed.
fn toi(kind: CandidateKind, x_t0: [[f32; 3]; 4], x_t1: [[f32; 3]; 4]) -> Option<f32> {
    let (a, b) = (points(x_t0), points(x_t1));
    let first = ccd(kind, a, b, 0.0).toi;
    for order in same_questions(kind) {
        let (a, b) = (order.map(|i| a[i]), order.map(|i| b[i]));
        for size in [1.0, 1024.0, 1.0 / 65536.0] {
            let found = ccd(kind, a.map(|v| v * size), b.map(|v| v * size), 0.0).toi;
            assert_eq!(found.is_some(), first.is_some(), "{kind:?} {x_t0:?} {x_t1:?} as {order:?} x {size}");
            if let (Some(found), Some(first)) = (found, first) {
                assert!((found - first).abs() < 1e-5, "{kind:?} {x_t0:?} {x_t1:?}: {found} and {first} as {order:?}");
            }
        }
        assert_eq!(ccd(kind, b, a, 0.0).toi.is_some(), first.is_some(), "{kind:?} {x_t0:?} {x_t1:?} reversed");
    }
    first
}

/// A vertex from `from` to `to` against the resting face.
fn vertex(from: [f32; 3], to: [f32; 3]) -> Option<f32> {
    let [a, b, c] = FACE;
    toi(VertexFace, [from, a, b, c], [to, a, b, c])
}

fn near(toi: Option<f32>, wanted: f32) {
    let toi = toi.expect("a hit");
    assert!(toi <= wanted && toi > wanted - 1e-5, "{toi} instead of {wanted}");
}

#[test]
fn a_vertex_approaches_a_face() {
    near(vertex([0.25, 0.25, 1.0], [0.25, 0.25, -1.0]), 0.5);
    near(vertex([0.25, 0.25, 1.0], [0.25, 0.25, -3.0]), 0.25);
    near(vertex([0.25, 0.25, 1.0], [0.25, 0.25, 0.0]), 1.0);
    for gap in EPSILONS {
        assert_eq!(vertex([0.25, 0.25, 1.0], [0.25, 0.25, gap]), None, "stops {gap} above");
        assert!(vertex([0.25, 0.25, 1.0], [0.25, 0.25, -gap]).is_some(), "stops {gap} below");
    }
}

#[test]
fn a_vertex_recedes_from_a_face() {
    assert_eq!(vertex([0.25, 0.25, 0.0], [0.25, 0.25, 1.0]), Some(0.0), "touching at the start");
    for gap in EPSILONS {
        assert_eq!(vertex([0.25, 0.25, gap], [0.25, 0.25, 1.0]), None);
        assert!(vertex([0.25, 0.25, -gap], [0.25, 0.25, 1.0]).is_some());
    }
}

#[test]
fn a_vertex_slides_past_a_face() {
    near(vertex([-1.0, 0.25, 0.0], [1.0, 0.25, 0.0]), 0.5);
    for gap in EPSILONS {
        assert_eq!(vertex([-1.0, 0.25, gap], [1.0, 0.25, gap]), None, "above");
        assert_eq!(vertex([-1.0, -gap, 0.0], [1.0, -gap, 0.0]), None, "in the plane, beside an edge");
        assert!(vertex([-1.0, gap, 0.0], [1.0, gap, 0.0]).is_some(), "in the plane, over an edge");
    }
    near(vertex([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]), 0.5);
}

#[test]
fn a_vertex_touches_the_border_of_a_face() {
    near(vertex([0.0, 0.0, 1.0], [0.0, 0.0, -1.0]), 0.5);
    near(vertex([1.0, 0.0, 1.0], [1.0, 0.0, -1.0]), 0.5);
    near(vertex([0.5, 0.5, 1.0], [0.5, 0.5, -1.0]), 0.5);
    near(vertex([0.5, 0.0, 1.0], [0.5, 0.0, -1.0]), 0.5);
    for gap in EPSILONS {
        assert_eq!(vertex([-gap, 0.25, 1.0], [-gap, 0.25, -1.0]), None, "beside an edge");
        assert_eq!(vertex([-gap, -gap, 1.0], [-gap, -gap, -1.0]), None, "beside a corner");
        assert_eq!(vertex([1.0 + gap.max(2e-7), 0.0, 1.0], [1.0 + gap.max(2e-7), 0.0, -1.0]), None, "beside a corner");
        assert!(vertex([gap, 0.25, 1.0], [gap, 0.25, -1.0]).is_some(), "inside of an edge");
    }
}

#[test]
fn nothing_moves() {
    assert_eq!(vertex([0.25, 0.25, 0.0], [0.25, 0.25, 0.0]), Some(0.0));
    assert_eq!(vertex([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]), Some(0.0));
    for gap in EPSILONS {
        assert_eq!(vertex([0.25, 0.25, gap], [0.25, 0.25, gap]), None);
        assert_eq!(vertex([-gap, 0.25, 0.0], [-gap, 0.25, 0.0]), None);
    }
}

/// The first edge from height `from` to `to` along x; the second rests along y, through the middle of the first.
fn crossing_edges(from: f32, to: f32, shift: f32) -> Option<f32> {
    let first = |z: f32| [[-1.0, shift, z], [1.0, shift, z]];
    let second = [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let at = |z: f32| [first(z)[0], first(z)[1], second[0], second[1]];
    toi(EdgeEdge, at(from), at(to))
}

#[test]
fn edges_cross() {
    near(crossing_edges(1.0, -1.0, 0.5), 0.5);
    near(crossing_edges(1.0, -1.0, 0.0), 0.5);
    near(crossing_edges(1.0, 0.0, 1.0), 1.0);
    assert_eq!(crossing_edges(0.0, 1.0, 0.0), Some(0.0));
    for gap in EPSILONS {
        assert_eq!(crossing_edges(1.0, gap, 0.5), None, "stops above");
        assert!(crossing_edges(1.0, -gap, 0.5).is_some(), "stops below");
        assert_eq!(crossing_edges(1.0, -1.0, -gap), None, "passes before the end");
        assert!(crossing_edges(1.0, -1.0, gap).is_some(), "passes behind the end");
    }
}

#[test]
fn parallel_and_collinear_edges() {
    let at = |from: f32, z: f32| [[from, 0., z], [from + 1.0, 0., z], [0., 0., 0.], [1., 0., 0.]];
    near(toi(EdgeEdge, at(0.5, 1.0), at(0.5, -1.0)), 0.5);
    near(toi(EdgeEdge, at(1.0, 1.0), at(1.0, -1.0)), 0.5);
    near(toi(EdgeEdge, at(3.0, 0.0), at(-1.0, 0.0)), 0.5);
    assert_eq!(toi(EdgeEdge, at(0.25, 0.0), at(0.25, 0.0)), Some(0.0));
    assert_eq!(toi(EdgeEdge, at(1.0 + 2e-7, 1.0), at(1.0 + 2e-7, -1.0)), None, "one behind the other");
    for gap in EPSILONS {
        assert_eq!(toi(EdgeEdge, at(0.5, 1.0), at(0.5, gap)), None);
        assert_eq!(toi(EdgeEdge, at(-3.0, gap), at(3.0, gap)), None, "along each other");
        assert!(toi(EdgeEdge, at(-3.0, -gap), at(3.0, gap)).is_some(), "along and through each other");
    }
}

#[test]
fn edges_in_one_plane() {
    // A slides in the plane of both towards the end of B.
    let at = |x: f32, y: f32| [[x, y, 0.], [x, y + 1.0, 0.], [0., 0., 0.], [1., 0., 0.]];
    near(toi(EdgeEdge, at(2.0, -0.5), at(0.0, -0.5)), 0.5);
    near(toi(EdgeEdge, at(2.0, 0.0), at(0.0, 0.0)), 0.5);
    for gap in EPSILONS {
        assert_eq!(toi(EdgeEdge, at(2.0, gap), at(-1.0, gap)), None);
    }
}

#[test]
fn collapsed_faces_and_edges() {
    let line = [[0., 0., 0.], [1., 0., 0.], [2., 0., 0.]];
    let with = |v: [f32; 3], face: [[f32; 3]; 3]| [v, face[0], face[1], face[2]];
    near(toi(VertexFace, with([0.5, 0., 1.], line), with([0.5, 0., -1.], line)), 0.5);
    near(toi(VertexFace, with([0., 0., 1.], [[0.; 3]; 3]), with([0., 0., -1.], [[0.; 3]; 3])), 0.5);
    let point = |x: [f32; 3]| [x, x, [0., 0., 0.], [1., 0., 0.]];
    near(toi(EdgeEdge, point([0.5, 0., 1.]), point([0.5, 0., -1.])), 0.5);
    for gap in EPSILONS {
        assert_eq!(toi(VertexFace, with([0.5, gap, 1.], line), with([0.5, gap, -1.], line)), None);
        assert_eq!(toi(VertexFace, with([gap, 0., 1.], [[0.; 3]; 3]), with([gap, 0., -1.], [[0.; 3]; 3])), None);
        assert_eq!(toi(EdgeEdge, point([0.5, gap, 1.]), point([0.5, gap, -1.])), None);
    }
    // A face that turns inside out through a line, with the vertex in its sweep and beside it.
    let flips = |y: f32| {
        toi(VertexFace, [[0.5, y, 0.], line[0], line[2], [1., 1., 0.]], [[0.5, y, 0.], line[0], line[2], [1., -1., 0.]])
    };
    near(flips(0.0).map(|t| t + 0.5), 0.5);
    assert!(flips(-0.125).is_some() && flips(0.125).is_some());
    assert_eq!(flips(-2.0), None);
}

#[test]
fn a_turning_edge_meets_and_passes_the_other() {
    // The ends of A change sides of B, whose end is reached at t = 1/2 when A is at x = 0.
    let at = |from: [f32; 2], x: f32| [[from[0], -1., 0.], [from[1], 1., 0.], [x, 0., -1.], [x, 0., 1.]];
    near(toi(EdgeEdge, at([-1., -1.], 0.), at([1., 1.], 0.)), 0.5);
    near(toi(EdgeEdge, at([-2., 1.], 1.), at([2., 1.], 1.)), 0.75);
    assert_eq!(toi(EdgeEdge, at([-2., 1.], 2.0), at([2., 1.], 2.0)), None);
}

#[test]
fn separation_is_a_distance() {
    let [a, b, c] = FACE.map(Vec3::from);
    let test = |from: [f32; 3], to: [f32; 3], separation: f32| {
        ccd(VertexFace, [from.into(), a, b, c], [to.into(), a, b, c], separation).toi
    };
    near(test([0.25, 0.25, 1.0], [0.25, 0.25, 0.0], 0.25), 0.75);
    // Past a corner along z: the Euclidean distance counts, not that along an axis.
    assert_eq!(test([-0.3, -0.4, 1.0], [-0.3, -0.4, -1.0], 0.4999), None);
    assert!(matches!(test([-0.3, -0.4, 1.0], [-0.3, -0.4, -1.0], 0.5001), Some(toi) if toi > 0.49 && toi < 0.5));
    assert_eq!(test([0.25, 0.25, 0.25], [0.25, 0.25, 1.0], 0.25), Some(0.0), "touching counts");
    assert_eq!(test([0.25, 0.25, 0.2500001], [0.25, 0.25, 1.0], 0.25), None);
}

#[test]
fn improper_numbers_are_hits_not_panics() {
    let [a, b, c] = FACE.map(Vec3::from);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for i in 0..4 {
            let mut x = [Vec3::new(5., 5., 5.), a, b, c];
            x[i].y = bad;
            for kind in [VertexFace, EdgeEdge] {
                assert_eq!(ccd(kind, x, [Vec3::new(5., 5., 5.), a, b, c], 0.0).toi, Some(0.0));
                assert!(proximity(kind, x, 1e-3).is_none());
            }
        }
    }
    let far = [Vec3::splat(5.0), a, b, c];
    assert_eq!(ccd(VertexFace, far, far, -1.0).toi, Some(0.0));
    assert_eq!(ccd(VertexFace, far, far, f32::NAN).toi, Some(0.0));
    let huge = far.map(|v| v * f32::MAX.sqrt() * 1e18);
    assert_eq!(ccd(VertexFace, huge, huge, 0.0).toi, None);
}

#[test]
fn the_filter_only_rejects_and_the_fallback_goes_on_from_it() {
    let [a, b, c] = FACE.map(Vec3::from);
    let x = |z: f32| [Vec3::new(0.25, 0.25, z), a, b, c];
    assert_eq!(ccd_filter(VertexFace, x(2.0), x(1.0), 0.0), Filtered::Apart(DecidedBy::Boxes));
    let tilted = [Vec3::new(0.4, 0.4, 0.4), a, b, Vec3::new(0., 1., 1.)];
    let answer = ccd_filter(VertexFace, tilted, tilted, 0.0);
    assert!(matches!(answer, Filtered::Undecided(_)) || answer == Filtered::Apart(DecidedBy::Planes));
    let Filtered::Undecided(start) = ccd_filter(VertexFace, x(1.0), x(-1.0), 0.0) else { panic!("rejected a hit") };
    assert!(start < 0.5 && start > 0.49);
    near(ccd_fallback(VertexFace, x(1.0), x(-1.0), 0.0, start).toi, 0.5);
    near(ccd_fallback(VertexFace, x(1.0), x(-1.0), 0.0, 0.0).toi, 0.5);
}

// --- closest points and proximity ------------------------------------------------------------------------------------

#[test]
fn closest_points_of_a_vertex_and_a_face() {
    let [a, b, c] = FACE;
    for (vertex, distance, weights, vertices) in [
        ([0.25, 0.25, 2.0], 2.0, [1., 0.5, 0.25, 0.25], 0b1111),
        ([0.5, -3.0, 0.0], 3.0, [1., 0.5, 0.5, 0.], 0b0111),
        ([-3.0, -4.0, 0.0], 5.0, [1., 1., 0., 0.], 0b0011),
        ([2.0, 2.0, 0.0], 4.5f32.sqrt(), [1., 0., 0.5, 0.5], 0b1101),
        ([0.25, 0.25, 0.0], 0.0, [1., 0.5, 0.25, 0.25], 0b1111),
    ] {
        let found = closest_points(VertexFace, points([vertex, a, b, c]));
        assert!((found.distance_squared.sqrt() - distance).abs() < 1e-6, "{vertex:?}: {found:?}");
        assert_eq!(found.weights, weights, "{vertex:?}");
        assert_eq!(found.feature.vertices, vertices, "{vertex:?}");
    }
}

#[test]
fn closest_points_of_edges() {
    let test = |x: [[f32; 3]; 4]| closest_points(EdgeEdge, points(x));
    let crossed = test([[-1., 0., 1.], [1., 0., 1.], [0., -1., 0.], [0., 3., 0.]]);
    assert_eq!((crossed.distance_squared, crossed.weights), (1.0, [0.5, 0.5, 0.75, 0.25]));
    assert!(crossed.feature.is_interior());
    let apart = test([[2., 0., 0.], [5., 0., 0.], [0., -1., 0.], [0., 1., 0.]]);
    assert_eq!((apart.distance_squared, apart.weights, apart.feature.count()), (4.0, [1., 0., 0.5, 0.5], 3));
    let parallel = test([[0.5, 2., 0.], [5., 2., 0.], [0., 0., 0.], [1., 0., 0.]]);
    assert_eq!(parallel.distance_squared, 4.0);
    let points_only = test([[3., 0., 0.], [3., 0., 0.], [0., 4., 0.], [0., 4., 0.]]);
    assert_eq!(points_only.distance_squared, 25.0);
}

#[test]
fn proximity_gives_the_offset_as_weights_and_normal() {
    let mut random = Seeded::new(12345);
    let mut number = || random.uniform(0.0, 1.0);
    let mut met = 0;
    for round in 0..20_000 {
        let mut x: [Vec3; 4] = std::array::from_fn(|_| Vec3::new(number(), number(), number()));
        if round % 4 == 0 {
            // Nearly parallel edges and needles.
            x[3] = x[2] + (x[1] - x[0]) * 0.7 + Vec3::splat(1e-6 * number());
        }
        for kind in [VertexFace, EdgeEdge] {
            let Some(contact) = proximity(kind, x, 0.3) else { continue };
            met += 1;
            assert!(contact.distance <= 0.3 && (contact.normal.length() - 1.0).abs() < 1e-5);
            assert!(contact.weights.iter().sum::<f32>().abs() < 1e-5);
            let offset: Vec3 = (0..4).map(|i| contact.weights[i] * x[i]).sum();
            assert!((offset - contact.distance * contact.normal).length() < 2e-5, "{kind:?} {x:?} {contact:?}");
            // No pair of sampled points is closer.
            for (s, t) in [(0., 0.), (0., 1.), (1., 0.), (0.5, 0.5), (0.25, 0.5), (number(), number())] {
                let pair = match kind {
                    VertexFace => x[0] - (x[1] + (x[2] - x[1]) * s + (x[3] - x[1]) * t * (1.0 - s)),
                    EdgeEdge => x[0] + (x[1] - x[0]) * s - x[2] - (x[3] - x[2]) * t,
                };
                assert!(pair.length() > contact.distance - 1e-5);
            }
        }
    }
    assert!(met > 10_000, "{met}");
}

#[test]
fn proximity_where_the_parts_touch() {
    let [a, b, c] = FACE;
    let on_face = proximity(VertexFace, points([[0.25, 0.25, 0.], a, b, c]), 1e-3).expect("a contact");
    assert_eq!((on_face.distance, on_face.normal.abs()), (0.0, Vec3::Z));
    let crossed = points([[-1., 0., 0.], [1., 0., 0.], [0., -1., 0.], [0., 1., 0.]]);
    let crossed = proximity(EdgeEdge, crossed, 0.0).expect("a contact");
    assert_eq!((crossed.distance, crossed.normal.abs()), (0.0, Vec3::Z));
    let one_place = proximity(EdgeEdge, [Vec3::ONE; 4], 0.0).expect("a contact");
    assert_eq!(one_place.normal.length(), 1.0);
}
