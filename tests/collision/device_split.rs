//! Searches with kernels by ranks that work together: what native searches find, culled in the same way, each candidate once,
//! tests evenly spread, and tables that shrink with the number of ranks.

use std::sync::Arc;

use loomtree::collision::Candidate;
use loomtree::collision::broad::{
    Broad, BroadError, BroadStats, Choice, DeviceBroad, Query, Search, Sink, Split, brute_force,
};
use loomtree::gpu::{CpuExecutor, Executor};
use loomtree::math::Vec3;
use loomtree::transport::InProcessTransport;
use support::collision::{Model, folded, ordered, sphere};
use support::device;
use support::seeded::Seeded;

const CULL: Choice = Choice { touched: None, piece_radius_m: None, cull: true };

/// An executor for every rank: twins or devices.
type Kind = fn(usize) -> Executor;

/// Twins, and devices if there are some.
fn kinds() -> Vec<Kind> {
    let mut kinds: Vec<Kind> = vec![|_| Executor::cpu(1)];
    if device::executor().is_some() {
        kinds.push(|rank| Executor::gpu(None, rank).expect("a device"));
    }
    kinds
}

struct Found(Vec<Candidate>);

impl Sink for Found {
    fn take(&mut self, found: &[Candidate]) {
        self.0.extend_from_slice(found);
    }
}

/// The candidates of the native search by one rank, sorted.
fn native(model: &Model, query: &Query, choice: &Choice) -> (Vec<Candidate>, BroadStats) {
    let (mut all, split) = (Vec::new(), &mut Split::alone(0, 1));
    let mut finish = |sink: Found| all.extend(sink.0);
    let (host, mut broad) = (CpuExecutor::new(1), Broad::new(model.mesh()));
    let search = Search { choice: *choice, ..Search::all(*query) };
    let stats = broad.search(&host, &search, split, &|| Found(Vec::new()), &mut finish);
    all.sort_unstable();
    (all, stats.expect("a search"))
}

type Searched = Result<(Vec<Candidate>, BroadStats), BroadError>;

/// What every rank finds and holds when all work together. Every query is asked twice: what the first leaves behind must not
/// matter.
fn together(
    kind: Kind,
    model: &Model,
    radius_m: f32,
    choice: &Choice,
    ranks: usize,
    limit: Option<u64>,
) -> Vec<Searched> {
    let mesh = Arc::new(model.mesh());
    let rank = |mut transport: InProcessTransport| {
        // Messages shorter than the lists.
        transport.set_max_message_values(700);
        let mut split = Split::together(&mut transport);
        let executor = kind(split.place().0);
        let (host, mut broad) = (CpuExecutor::new(1), DeviceBroad::new(&executor, mesh.clone()));
        let mut search = || {
            let (mut found, query) = (Vec::new(), model.query(radius_m));
            let emit = &mut |some: &[Candidate]| found.extend_from_slice(some);
            let search = Search { choice: *choice, memory_limit_bytes: limit, ..Search::all(query) };
            let stats = broad.search((&executor, &host), &search, &mut split, emit)?;
            found.sort_unstable();
            Ok((found, stats.expect("few tests in a cell")))
        };
        let first: Searched = search();
        if let Ok((found, stats)) = &first {
            let (again, other) = search().expect("the same query");
            assert_eq!((found, stats.tests, stats.batches), (&again, other.tests, other.batches));
        }
        first
    };
    std::thread::scope(|scope| {
        let group = InProcessTransport::group(ranks);
        let ranks: Vec<_> = group.into_iter().map(|transport| scope.spawn(|| rank(transport))).collect();
        ranks.into_iter().map(|rank| rank.join().expect("a rank")).collect()
    })
}

fn sorted(lists: &[(Vec<Candidate>, BroadStats)]) -> Vec<Candidate> {
    let mut all: Vec<Candidate> = lists.iter().flat_map(|(found, _)| found.iter().copied()).collect();
    all.sort_unstable();
    all
}

/// A folded sheet that moves, a waving one far from it that culling leaves out, one large triangle of cloth, a ball of about
/// the cloth's size and a floor of two triangles.
fn scene(n: usize) -> Model {
    let mut random = Seeded::new(7);
    let mut model = Model::default();
    let place = |u: f32, v: f32| folded(u, v) + Vec3::new(0.0, 2.0 * v, 0.0);
    model.sheet(n, n - 9, place, |x| x + 0.001 * random.vector());
    model.sheet(n, n / 2, |u, v| Vec3::new(1.0 + 2.0 * u, 3.0 * v, 0.1 * (9.0 * u).sin()), |x| x - 0.01 * Vec3::Z);
    model.sheet(2, 2, |u, v| Vec3::new(2.0 * u - 1.0, v, 0.3 + 0.1 * v), |x| x - 0.05 * Vec3::Z);
    let places = model.x0.clone();
    let mut model = ordered(&model, |v| places[v]);
    model.obstacles_follow();
    model.sheet(12, 12, sphere(Vec3::new(0.0, 1.0, 0.1), 0.4), |x| x);
    model.sheet(2, 2, |u, v| Vec3::new(40.0 * u - 20.0, 40.0 * v - 20.0, 0.01), |x| x + 0.01 * Vec3::Z);
    model
}

#[test]
fn any_number_of_ranks_finds_what_native_searches_find() {
    for kind in kinds() {
        for (n, radius_m) in [(23, 0.004), (48, 0.003)] {
            let model = scene(n);
            let query = model.query(radius_m);
            for cull in [false, true] {
                let choice = Choice { cull, ..CULL };
                let (expected, stats) = native(&model, &query, &choice);
                if !cull {
                    assert!(expected == brute_force(&model.mesh(), &query).expect("brute force"));
                }
                assert!(expected.len() > 1000, "{} candidates", expected.len());
                for ranks in [1, 2, 3, 4, 8].into_iter().filter(|ranks| n < 40 || ranks % 4 == 0) {
                    let found = together(kind, &model, radius_m, &choice, ranks, None);
                    let found: Vec<_> = found.into_iter().map(|rank| rank.expect("a search")).collect();
                    let all = sorted(&found);
                    assert!(all == expected, "{ranks} ranks, cull {cull}: {} of {}", all.len(), expected.len());
                    assert!(found.iter().all(|(_, own)| own.patches == stats.patches && own.cells == found[0].1.cells));
                }
            }
        }
    }
}

#[test]
fn tests_are_even_and_tables_shrink() {
    let radius_m = 0.002;
    for kind in kinds() {
        let mut model = Model::default();
        let mut random = Seeded::new(9);
        let place = |u: f32, v: f32| folded(u, v) + Vec3::new(0.0, 2.0 * v, 0.0);
        model.sheet(100, 80, place, |x| x + 0.001 * random.vector());
        let mut model = ordered(&model, |v| Vec3::new((v % 100) as f32, (v / 100) as f32, 0.0));
        model.obstacles_follow();
        model.sheet(12, 12, sphere(Vec3::new(0.0, 1.0, 0.1), 0.4), |x| x);
        for cull in [false, true] {
            let choice = Choice { cull, ..CULL };
            let search = |ranks| {
                let found = together(kind, &model, radius_m, &choice, ranks, None);
                found.into_iter().map(|rank| rank.expect("a search").1).collect::<Vec<BroadStats>>()
            };
            let alone = search(1)[0];
            for ranks in [2, 4, 8] {
                let all = search(ranks);
                assert!(all.iter().all(|own| own.tests_total == alone.tests_total && own.patches == alone.patches));
                assert_eq!(all.iter().map(|own| own.tests).sum::<u64>(), alone.tests_total);
                let most = all.iter().map(|own| own.tests).max().expect("ranks") as f64;
                assert!(most <= 1.05 * alone.tests_total as f64 / ranks as f64, "{most} tests of {alone:?}");
                let bytes = all.iter().map(|own| own.bytes).max().expect("ranks") as f64 / alone.bytes as f64;
                println!("{ranks} ranks, cull {cull}: {bytes:.3} of the {} bytes of one", alone.bytes);
                assert!(bytes <= 1.25 / ranks as f64 + 0.1, "{ranks} ranks hold {bytes} of what one holds");
            }
        }
    }
}

#[test]
fn a_memory_limit_changes_nothing_for_ranks_that_work_together() {
    for kind in kinds() {
        let (model, radius_m) = (scene(70), 0.002);
        let (expected, _) = native(&model, &model.query(radius_m), &CULL);
        let free = together(kind, &model, radius_m, &CULL, 1, None);
        let free = free[0].as_ref().expect("a search").1.bytes;
        for ranks in [1, 2, 4] {
            // What each rank says it needs, and then the most of it.
            let needs = |refused: Searched| match refused {
                Err(BroadError::MemoryLimit { needs_bytes, limit_bytes: 1000 }) => needs_bytes,
                other => panic!("{:?}", other.map(|(found, stats)| (found.len(), stats))),
            };
            let refused = together(kind, &model, radius_m, &CULL, ranks, Some(1000));
            let limit = refused.into_iter().map(needs).max().expect("ranks");
            assert!(limit < free, "{limit} of {free}");
            let found = together(kind, &model, radius_m, &CULL, ranks, Some(limit));
            let found: Vec<_> = found.into_iter().map(|rank| rank.expect("room enough")).collect();
            assert!(sorted(&found) == expected, "{ranks} ranks");
            assert!(found.iter().all(|(_, own)| own.bytes <= limit), "{limit} bytes");
            assert!(ranks > 1 || found[0].1.batches > 1, "{:?}", found[0].1);
        }
    }
}

#[test]
fn a_waving_sheet_takes_no_part_on_a_device() {
    let wave = |u: f32, v: f32| Vec3::new(u, v, 0.05 * (9.0 * u + 2.0 * v).sin());
    let mut model = Model::default();
    model.sheet(64, 64, wave, |x| x + Vec3::new(0.02, 0.0, -0.02));
    let model = ordered(&model, |v| Vec3::new((v % 64) as f32, (v / 64) as f32, 0.0));
    for kind in kinds() {
        for radius_m in [0.0, 0.3 / 60.0] {
            for ranks in [1, 2] {
                for own in together(kind, &model, radius_m, &CULL, ranks, None) {
                    let (found, stats) = own.expect("a search");
                    assert!(found.is_empty());
                    assert_eq!((stats.tests_total, stats.patches[0]), (0, 0), "{stats:?}");
                }
            }
            let all = together(kind, &model, radius_m, &Choice { cull: false, ..CULL }, 1, None);
            assert!(all[0].as_ref().expect("a search").1.tests_total > 10_000);
        }
    }
}

#[test]
fn everything_in_one_place_and_less_than_there_are_ranks() {
    for kind in kinds() {
        // One layer has all tests; and two triangles that meet.
        let mut random = Seeded::new(3);
        let mut heap = Model::default();
        for _ in 0..40 {
            let place = 0.01 * random.vector();
            heap.sheet(2, 2, |u, v| place + 0.02 * Vec3::new(u, v, u * v), |x| x);
        }
        let mut two = Model::default();
        two.sheet(2, 2, |u, v| Vec3::new(u, v, 0.0), |x| x);
        two.triangles.truncate(1);
        two.sheet(2, 2, |u, v| Vec3::new(u, 0.1, v - 0.5), |x| x);
        for model in [heap, two] {
            let expected = brute_force(&model.mesh(), &model.query(0.001)).expect("brute force");
            assert!(!expected.is_empty());
            for ranks in [1, 3, 8] {
                let found = together(kind, &model, 0.001, &CULL, ranks, None);
                let found: Vec<_> = found.into_iter().map(|rank| rank.expect("a search")).collect();
                assert!(sorted(&found) == expected, "{ranks} ranks");
            }
        }
    }
}
