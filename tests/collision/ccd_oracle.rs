//! Continuous collision against the exact referee in `support::exact`, from fixed seeds: a million random queries, a
//! hundred thousand nearly degenerate ones in families. `LOOMTREE_CCD_QUERIES` sets another number of random queries,
//! and a tenth of it for each family.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering};

use loomtree::collision::elementary::CandidateKind::{self, EdgeEdge, VertexFace};
use loomtree::collision::elementary::{DecidedBy, ccd};
use loomtree::math::Vec3;
use support::exact::{Grid, first_contact};
use support::seeded::Seeded;

/// Random queries; the referee is fast where most queries are far from touching.
const RANDOM: u32 = 1_000_000;
/// Queries of each nearly degenerate family: 100,800 in all nine.
const FAMILY: u32 = 11_200;
/// Independent parts of a series of queries, each with a seed of its own: threads share them.
const PARTS: u32 = 8;

/// Queries asked for by the environment.
fn asked() -> Option<u32> {
    std::env::var("LOOMTREE_CCD_QUERIES").ok().map(|text| text.parse().expect("a number of queries"))
}

/// From -limit to limit.
fn integer(random: &mut Seeded, limit: i64) -> i64 {
    (random.bits64() % (2 * limit as u64 + 1)) as i64 - limit
}

fn point(random: &mut Seeded, limit: i64) -> [i64; 3] {
    std::array::from_fn(|_| integer(random, limit))
}

fn stencil(random: &mut Seeded, limit: i64) -> Grid {
    std::array::from_fn(|_| point(random, limit))
}

#[derive(Debug, Default)]
struct Tally {
    queries: u32,
    hits: u32,
    false_hits: u32,
    limited: u32,
    by_filter: u32,
}

impl Tally {
    /// Asks `count` queries on several threads; what is asked does not depend on how many there are.
    fn series(count: u32, seed: u64, ask: impl Fn(&mut Tally, &mut Seeded, u32) + Sync) -> Tally {
        let next = AtomicU32::new(0);
        let all = Mutex::new(Tally::default());
        let threads = std::thread::available_parallelism().map_or(1, |threads| threads.get()).min(PARTS as usize);
        std::thread::scope(|scope| {
            for _ in 0..threads {
                scope.spawn(|| {
                    loop {
                        let part = next.fetch_add(1, Ordering::Relaxed);
                        if part >= PARTS {
                            break;
                        }
                        let (mut tally, mut random) = (Tally::default(), Seeded::new(seed + (u64::from(part) << 32)));
                        (count * part / PARTS..count * (part + 1) / PARTS)
                            .for_each(|i| ask(&mut tally, &mut random, i));
                        all.lock().expect("no part failed").add(&tally);
                    }
                });
            }
        });
        let all = all.into_inner().expect("no part failed");
        assert_eq!(all.queries, count);
        all
    }

    fn add(&mut self, other: &Tally) {
        self.queries += other.queries;
        self.hits += other.hits;
        self.false_hits += other.false_hits;
        self.limited += other.limited;
        self.by_filter += other.by_filter;
    }

    /// Asks both; a miss, or a time later than the first contact, fails the test.
    fn ask(&mut self, kind: CandidateKind, x_t0: Grid, x_t1: Grid) {
        // Down to subnormal and up to nearly infinite numbers: the same question.
        let size = 2f64.powi([0, -140, -20, 100, 0, -60][self.queries as usize % 6]);
        let place = |x: Grid| x.map(|p| Vec3::from(p.map(|c| (c as f64 * size) as f32)));
        let small = |x: &Grid| x.iter().flatten().all(|c| c.abs() <= 1 << 24);
        assert!(small(&x_t0) && small(&x_t1), "the grid must fit f32");
        let ours = ccd(kind, place(x_t0), place(x_t1), 0.0);
        let truth = first_contact(kind, x_t0, x_t1);
        self.queries += 1;
        self.hits += u32::from(truth.is_some());
        self.limited += u32::from(ours.decided_by == DecidedBy::PlaneLimit);
        self.by_filter += u32::from(matches!(ours.decided_by, DecidedBy::Boxes | DecidedBy::Planes));
        match (truth, ours.toi) {
            (Some(truth), None) => panic!("missed {kind:?} {x_t0:?} {x_t1:?}: {truth:?}"),
            (Some(truth), Some(toi)) => {
                assert!(f64::from(toi) <= truth.high, "late {kind:?} {x_t0:?} {x_t1:?}: {toi} after {truth:?}")
            }
            (None, Some(_)) => self.false_hits += 1,
            (None, None) => {}
        }
    }
}

#[test]
fn random_stencils() {
    let tally = Tally::series(asked().unwrap_or(RANDOM), 1, |tally, random, i| {
        let kind = if i % 2 == 0 { VertexFace } else { EdgeEdge };
        let limit = 1 << (1 + random.bits64() % 24);
        let x_t0 = stencil(random, limit);
        let x_t1 = if i % 3 == 0 {
            // A step of cloth: small beside the shape.
            let step = stencil(random, (limit / 8).max(1));
            std::array::from_fn(|v| std::array::from_fn(|c| (x_t0[v][c] + step[v][c]).clamp(-limit, limit)))
        } else {
            stencil(random, limit)
        };
        tally.ask(kind, x_t0, x_t1);
    });
    println!("random: {tally:?}");
    assert!(tally.hits > tally.queries / 50, "hits must occur: {tally:?}");
    assert!(tally.false_hits * 1000 <= tally.queries, "{tally:?}");
}

/// Runs the queries of `make` for both kinds.
fn family(name: &str, seed: u64, make: impl Fn(&mut Seeded, CandidateKind) -> (Grid, Grid) + Sync) {
    let tally = Tally::series(asked().map_or(FAMILY, |random| random / 10), seed, |tally, random, i| {
        let kind = if i % 2 == 0 { VertexFace } else { EdgeEdge };
        let (x_t0, x_t1) = make(random, kind);
        tally.ask(kind, x_t0, x_t1);
    });
    println!("{name}: {tally:?}");
    assert!(tally.hits * 50 > tally.queries, "hits must occur: {tally:?}");
}

fn jitter(random: &mut Seeded, x: Grid, by: i64) -> Grid {
    x.map(|p| p.map(|c| c + integer(random, by)))
}

#[test]
fn small_grids_full_of_exact_touching() {
    // On a grid of few points vertices on faces, parallel edges, collapsed faces and coplanar motion are common.
    for (seed, limit) in [(10, 1), (11, 2), (12, 4)] {
        family("small grid", seed, |random, _| (stencil(random, limit), stencil(random, limit)));
    }
}

#[test]
fn coplanar_motion() {
    family("coplanar", 20, |random, _| {
        let limit = 1 << (2 + random.bits64() % 16);
        let mut flat = || stencil(random, limit).map(|[x, y, _]| [x, y, x + 2 * y]);
        (flat(), flat())
    });
    family("nearly coplanar", 21, |random, _| {
        let mut flat = || {
            let x = stencil(random, 1 << 20).map(|[x, y, _]| [x, y, x + 2 * y]);
            jitter(random, x, 1)
        };
        (flat(), flat())
    });
}

#[test]
fn parallel_edges_and_needles() {
    family("nearly parallel", 30, |random, _| {
        // Both run along the same direction and pass through each other at t = 1/2, half of them up to one unit.
        let (along, offset, slide) = (point(random, 1 << 16), point(random, 1 << 12), integer(random, 3));
        let off = integer(random, 1).abs();
        let mut x = |sign: i64| {
            let start = point(random, 1 << 20);
            let at =
                |times: i64, side: i64| std::array::from_fn(|c| start[c] + times * along[c] + side * sign * offset[c]);
            let x = [at(0, 0), at(5, 0), at(slide, 1), at(slide + 7, 1)];
            jitter(random, x, off)
        };
        (x(1), x(-1))
    });
}

#[test]
fn aimed_at_a_common_point() {
    // At t = 1/2 the closest points coincide, or miss by one unit of the grid.
    for (seed, off) in [(40, 0), (41, 1)] {
        family("aimed", seed, |random, kind| {
            let mut middle = stencil(random, 1 << 18);
            let [s, t] = [integer(random, 4).abs(), integer(random, 4).abs()];
            match kind {
                VertexFace => {
                    let t = t.min(4 - s);
                    for c in 0..3 {
                        middle[1][c] &= !3;
                        let (ab, ac) = ((middle[2][c] - middle[1][c]) & !3, (middle[3][c] - middle[1][c]) & !3);
                        (middle[2][c], middle[3][c]) = (middle[1][c] + ab, middle[1][c] + ac);
                        middle[0][c] = middle[1][c] + ab / 4 * s + ac / 4 * t;
                    }
                }
                EdgeEdge => {
                    for c in 0..3 {
                        let (u, v) = ((middle[1][c] - middle[0][c]) & !3, (middle[3][c] - middle[2][c]) & !3);
                        middle[1][c] = middle[0][c] + u;
                        middle[2][c] = middle[0][c] + u / 4 * s - v / 4 * t;
                        middle[3][c] = middle[2][c] + v;
                    }
                }
            }
            let motion = stencil(random, 1 << 18);
            let start = std::array::from_fn(|v| std::array::from_fn(|c| middle[v][c] - motion[v][c]));
            let end: Grid = std::array::from_fn(|v| std::array::from_fn(|c| middle[v][c] + motion[v][c]));
            (start, jitter(random, end, off))
        });
    }
}

#[test]
fn grazing() {
    // Coplanarity has a double root: the vertex of a parabola in time touches the face, or misses by little.
    family("grazing", 50, |random, _| {
        let (reach, lift) = (1 << 12, integer(random, 1));
        let x = |sign: i64, height: i64| {
            [[0, 0, height], [-reach, -reach, sign * -reach], [reach, -reach, sign * reach], [0, reach, 0]]
        };
        let slope = integer(random, 64);
        let mut start = x(1, lift);
        let mut end = x(-1, lift);
        for (grid, sign) in [(&mut start, 1), (&mut end, -1)] {
            grid[0][0] += sign * slope;
            grid[0][2] += slope * integer(random, 1);
        }
        (start, end)
    });
}
