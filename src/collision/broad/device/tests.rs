//! Every kernel against its native twin, on seeded triangles of odd numbers and very different sizes.

use std::ops::Range;

use bytemuck::Zeroable;

use super::batches::Chunk;
use super::count::{face, numbered_pieces};
use super::hash::{DeviceEntries, DeviceTable, HashParams, Shapes, Window};
use super::pairs::{BOXES_ONLY, BY_PAIR, FoundPairs, PairParams, SEPARATION};
use super::search::pair_params;
use super::space::{Nested, Space};
use crate::collision::Candidate;
use crate::collision::broad::active::ActivePatches;
use crate::collision::broad::boxes::Trajectories;
use crate::collision::broad::input::Input;
use crate::collision::broad::patches::Patches;
use crate::collision::broad::{Choice, CollisionMesh, Filter, Query, Split};
use crate::gpu::{CpuExecutor, DeviceVec, Executor};
use crate::test_support::device;
use crate::test_support::seeded::Seeded;

/// Cloth triangles of sizes from 1 to 1000 in one place, some of them neighbors, then obstacles.
fn mesh(triangles: usize, seed: u64) -> (CollisionMesh, Vec<f32>, Vec<f32>) {
    let mut seeded = Seeded::new(seed);
    let mut corners = Vec::new();
    let (mut x_t0, mut x_t1) = (Vec::new(), Vec::new());
    for t in 0..triangles {
        let first = (x_t0.len() / 3) as u32;
        let size = [0.01, 0.01, 0.02, 0.3, 10.0][(t % 5).min(t % 41)];
        let middle: [f32; 3] = std::array::from_fn(|_| seeded.uniform(-0.3, 0.3));
        for _ in 0..3 {
            for at in middle {
                x_t0.push(at + seeded.uniform(-size, size));
                x_t1.push(x_t0[x_t0.len() - 1] + seeded.uniform(-0.01, 0.01));
            }
        }
        // Every seventh triangle shares an edge with the one before.
        let shares = t % 7 == 6 && t != triangles / 2;
        corners.push(if shares { [first - 2, first, first - 1] } else { [first, first + 1, first + 2] });
    }
    let cloth = 3 * (triangles / 2);
    (CollisionMesh::new(x_t0.len() / 3, cloth, corners).expect("a mesh"), x_t0, x_t1)
}

/// All that the kernels make on one executor; what has no order is sorted.
#[derive(PartialEq)]
struct Made {
    boxes: Vec<[u32; 4]>,
    counts: Vec<[u32; 4]>,
    loads: Vec<[u32; 4]>,
    test_starts: Vec<u32>,
    starts: Vec<u32>,
    entries: Vec<[u32; 2]>,
    pairs: Vec<[u32; 2]>,
    candidates: [Vec<Candidate>; 3],
}

/// A query without culling.
struct Case<'a> {
    mesh: &'a CollisionMesh,
    query: &'a Query<'a>,
    input: Input<'a>,
    patches: Patches,
    space: Space,
}

impl<'a> Case<'a> {
    fn new(mesh: &'a CollisionMesh, query: &'a Query<'a>) -> Case<'a> {
        let choice = Choice { piece_radius_m: Some(0.002), ..Choice::default() };
        let input = Input::new(mesh, Trajectories::new(mesh, query, &choice).expect("positions"), choice);
        let (nested, mut active) = (Nested::new(&input.grid), ActivePatches::new(mesh));
        let split = &mut Split::alone(0, 1);
        active.find(&CpuExecutor::new(1), &input, |aabb| nested.may_be_large(aabb), split).expect("one rank");
        let patches = active.patches;
        let space = Space::new(&input, &patches);
        Case { mesh, query, input, patches, space }
    }

    /// Counts some layers.
    fn count(&self, executor: &Executor, layers: Range<usize>) -> (Window, Shapes, DeviceTable, Vec<[u32; 4]>) {
        let members = self.space.members(&self.input, &self.patches, &layers);
        let window = self.space.window(&self.input, layers, &members);
        let pieces = numbered_pieces(self.mesh);
        let faces: Vec<_> = members.iter().map(|&t| face(self.mesh, &pieces, t)).collect();
        let shapes = Shapes {
            x_t0: DeviceVec::upload(executor, self.query.x_t0),
            x_t1: Some(DeviceVec::upload(executor, self.query.x_t1)),
            faces: DeviceVec::upload(executor, &faces),
        };
        let mut table = DeviceTable::new(executor);
        let loads = table.count(executor, &window, &shapes);
        (window, shapes, table, loads)
    }
}

/// Of all layers, or of the part number `part` of 4 and all its chunks but for the first.
fn made(executor: &Executor, triangles: usize, part: usize) -> Made {
    let (mesh, x_t0, x_t1) = mesh(triangles, 5);
    let query = Query { x_t0: &x_t0, x_t1: &x_t1, radius_m: 0.01 };
    let case = Case::new(&mesh, &query);
    let layers = if part == 0 { 0..case.space.layers() } else { case.space.guess(part, 4) };
    let (window, shapes, mut table, loads) = case.count(executor, layers);
    let members = window.params.triangles as usize;
    assert!(part == 0 || (members > 0 && members < triangles));
    let chunks: Vec<Chunk> = window.chunks.iter().zip(&loads).map(|(&of, &load)| Chunk::new(of, load)).collect();
    let chunks = &chunks[part.min(1)..];
    let size: u64 = chunks.iter().map(|chunk| chunk.entries).sum();
    let tests: u64 = chunks.iter().map(|chunk| chunk.tests).sum();
    let first = chunks.first().expect("chunks").buckets[0] as usize;
    let buckets = window.params.buckets - first as u32;
    let params = HashParams { first_bucket: first as u32, buckets, ..window.params };
    let mut entries = DeviceEntries::new(executor);
    table.fill(executor, &params, size as usize, &mut entries);
    let starts = entries.starts.read(executor);
    let counts = table.counts.read(executor);
    let mut listed = entries.entries.read(executor);
    for (bucket, load) in counts[first..].iter().enumerate() {
        let mut at = starts[bucket] as usize;
        for class in load.iter().filter(|_| starts[bucket] < starts[bucket + 1]) {
            listed[at..at + *class as usize].sort_unstable();
            at += *class as usize;
        }
    }
    entries.entries.write_range(executor, 0, &listed);
    let mut found = FoundPairs::new(executor);
    let pass = PairParams {
        first_bucket: params.first_bucket,
        buckets: params.buckets,
        first_test: (tests / 9) as u32,
        end_test: tests as u32,
        ..pair_params(&case.input.paths, &Filter::Boxes)
    };
    // Without room pairs are counted all the same.
    let count = found.box_tests(executor, &pass, &table, &entries);
    found.pairs.resize(executor, count);
    assert_eq!(found.box_tests(executor, &pass, &table, &entries), count);
    let mut pairs = found.pairs.read(executor);
    pairs.sort_unstable();
    found.pairs.write_range(executor, 0, &pairs);
    let reach_m: Vec<f32> = (0..mesh.vertices).map(|v| 0.001 * (v % 5) as f32).collect();
    let reach_m = DeviceVec::upload(executor, &reach_m);
    let candidates = [BOXES_ONLY, BY_PAIR, SEPARATION].map(|filter_kind| {
        let pass = PairParams {
            first_pair: (count / 7) as u32,
            end_pair: count as u32,
            filter_kind,
            separation_m: 0.003,
            ..pass
        };
        let mut out = FoundPairs::new(executor);
        out.pairs.assign(executor, &pairs);
        let count = out.feature_pairs(executor, &pass, &table, &shapes, &reach_m);
        out.candidates.resize(executor, count);
        assert_eq!(out.feature_pairs(executor, &pass, &table, &shapes, &reach_m), count);
        let mut list = out.candidates.read(executor);
        list.sort_unstable();
        list
    });
    assert_eq!(executor.take_fault(), None);
    Made {
        boxes: table.boxes.read(executor),
        counts,
        loads,
        test_starts: entries.test_starts.read(executor),
        starts,
        entries: listed,
        pairs,
        candidates,
    }
}

#[test]
fn kernels_equal_their_twins() {
    let Some(device) = device::executor() else { return };
    for (triangles, part) in [(1, 0), (129, 0), (1001, 0), (1001, 1), (2500, 2)] {
        let (found, expected) = (made(&device, triangles, part), made(&Executor::cpu(1), triangles, part));
        assert!(found.boxes == expected.boxes, "boxes of {triangles}");
        assert!(found.counts == expected.counts && found.loads == expected.loads, "loads of {triangles}");
        assert!(found.test_starts == expected.test_starts && found.starts == expected.starts, "sums of {triangles}");
        assert!(found.entries == expected.entries, "entries of {triangles}");
        assert!(found.pairs == expected.pairs, "pairs of {triangles}");
        assert!(found.candidates[0] == expected.candidates[0], "candidates of {triangles}");
        let visited = expected.counts.iter().any(|load| load[2] > 0 && load[3] > 0);
        assert!(triangles < 1000 || visited, "visitors of {triangles}");
        // Rounding may differ where a pair is just proven apart; what a filter leaves is a part of what it was given.
        for kind in [1, 2] {
            let (ours, twins) = (&found.candidates[kind], &expected.candidates[kind]);
            let differ = ours.iter().filter(|c| twins.binary_search(c).is_err()).count()
                + twins.iter().filter(|c| ours.binary_search(c).is_err()).count();
            assert!(1000 * differ <= twins.len(), "filter {kind} of {triangles}: {differ} of {}", twins.len());
            assert!(ours.iter().all(|c| found.candidates[0].binary_search(c).is_ok()));
            assert!(triangles < 100 || (!ours.is_empty() && ours.len() < found.candidates[0].len()));
        }
    }
}

#[test]
fn parts_of_space_are_counted_in_full() {
    // Near the origin of all coordinates, and so far from it that positions are rounded to parts of a cell.
    for (triangles, away) in [(700, 0.0), (2500, 0.0), (2500, 3000.0), (2500, 40_000.0)] {
        let (mesh, mut x_t0, mut x_t1) = mesh(triangles, 6);
        // A third of it stays where it is.
        let moved = 3 * (mesh.vertices / 3);
        x_t0[moved..].iter_mut().chain(&mut x_t1[moved..]).for_each(|x| *x += away);
        let query = Query { x_t0: &x_t0, x_t1: &x_t1, radius_m: 0.01 };
        let case = Case::new(&mesh, &query);
        for executor in std::iter::once(Executor::cpu(1)).chain(device::executor()) {
            let whole = case.count(&executor, 0..case.space.layers()).2.counts.read(&executor);
            assert_eq!(whole.len(), case.space.buckets());
            assert!(whole.iter().map(|load| load[0] + load[1]).sum::<u32>() as usize > triangles / 2);
            for ranks in [2, 5, 16] {
                let count = |rank| {
                    let layers = case.space.guess(rank, ranks);
                    if layers.is_empty() { vec![] } else { case.count(&executor, layers).2.counts.read(&executor) }
                };
                let parts: Vec<[u32; 4]> = (0..ranks).flat_map(count).collect();
                assert!(parts == whole, "{triangles} triangles {away} m away on {ranks} ranks, {}", executor.name());
            }
        }
    }
}

#[test]
fn tests_beyond_32_bits_are_counted() {
    // A bucket of 200,000 residents of cloth and 70,000 visitors.
    let load = [200_000, 3, 70_000, 9];
    let expected = 200_000u64 * 199_999 / 2 + 200_000 * (3 + 70_000 + 9) + 3 * 70_000;
    for executor in std::iter::once(Executor::cpu(1)).chain(device::executor()) {
        let mut table = DeviceTable::new(&executor);
        table.counts.resize(&executor, 40);
        table.counts.fill_zero(&executor);
        table.counts.write_range(&executor, 5, &[load]);
        let params = HashParams { chunks: 2, ..HashParams::zeroed() };
        let spans = [[0, 7], [7, 40]];
        let loads = table.loads(&executor, &params, &spans);
        let [full, empty] = [0, 1].map(|at| Chunk::new(spans[at], loads[at]));
        assert_eq!((full.tests, full.entries, full.busy), (expected, 270_012, 1), "{}", executor.name());
        assert!(full.is_too_much() && !empty.is_too_much() && empty.tests == 0);
    }
}
