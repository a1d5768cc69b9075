//! Emulated links: nothing arrives before the clock says so, stragglers delay what is behind them, time-outs strike, bits
//! stay the same. Times are only bounded from below: how much later a busy machine hands a message over is its own affair
//! (`docs/performance.md` has measured figures).

use std::time::{Duration, Instant};

use loomtree::interconnect::{Duplex, Plan, RankLinks, ScheduleKind, Topology, Traffic, plan};
use loomtree::transport::{EmulatedTransport, InProcessTransport, Neighbor, Pattern, Rows, Transport, TransportError};
use support::process::{Place, flag, repository};

/// Values of a sub-vector.
const LEN: usize = 3000;
const BYTES: f64 = LEN as f64 * 4.0;
/// Exchanges one after the other.
const ROUNDS: u32 = 5;
const PATIENT: Duration = Duration::from_secs(60);

/// A tree whose links carry a sub-vector in 4 ms.
fn slow_tree(ranks: usize) -> Topology {
    Topology::balanced_tree(ranks, 0.003, 100.0, Duplex::Full).expect("a tree")
}

fn no_halo(ranks: usize) -> Traffic {
    Traffic { published: vec![0.0; ranks], received: vec![vec![0.0; ranks]; ranks] }
}

/// Runs a program on every rank with the links of `topology`.
fn on_ranks<T: Send>(
    topology: &Topology,
    plan: &Plan,
    halo: &Traffic,
    deadline: Duration,
    program: impl Fn(&mut dyn Transport) -> T + Sync,
) -> Vec<T> {
    let links = RankLinks::of(topology, plan, BYTES, halo);
    let program = &program;
    std::thread::scope(|scope| {
        let ranks: Vec<_> = InProcessTransport::group(topology.gpus())
            .into_iter()
            .zip(links)
            .map(|(inner, links)| scope.spawn(move || program(&mut EmulatedTransport::new(inner, links, deadline))))
            .collect();
        ranks.into_iter().map(|rank| rank.join().expect("a rank")).collect()
    })
}

/// Starts an exchange of whole sub-vectors.
fn publish(transport: &mut dyn Transport, value: f32) {
    let pattern = Pattern::whole(transport.rank(), &vec![LEN; transport.ranks()]);
    transport.start(&pattern, 1, &mut |out| out.fill(value)).expect("started");
}

/// Two ranks read `rows` rows of a message of [`LEN`] of each other.
fn halo_of_two(rank: usize, rows: u32) -> Pattern {
    let neighbor = || vec![Neighbor { rank: 1 - rank, message_rows: LEN, rows: Rows::At((0..rows).collect()) }];
    Pattern::new(LEN, neighbor(), neighbor())
}

#[test]
fn no_sub_vector_arrives_before_its_time() {
    let topology = slow_tree(4);
    for kind in [ScheduleKind::FatTree, ScheduleKind::Ring, ScheduleKind::Direct, ScheduleKind::Best] {
        let plan = plan(kind, &topology, BYTES).unwrap();
        let links = RankLinks::of(&topology, &plan, BYTES, &no_halo(4));
        let took = on_ranks(&topology, &plan, &no_halo(4), PATIENT, |transport| {
            // A wait that ends late is made up for in the next ones, so rounds count from the start of the first.
            let start = Instant::now();
            transport.barrier().unwrap();
            let rank = transport.rank();
            let done = |receipt: &loomtree::interconnect::Receipt| receipt.done.full_s;
            let exchange_s = links[rank].whole.iter().map(done).fold(0.0, f64::max);
            for round in 0..ROUNDS {
                publish(transport, rank as f32);
                for node in &plan.schedule.queues[rank] {
                    let seen =
                        transport.finish(node.vector, &mut |got| assert_eq!(got.values(), [node.vector as f32; LEN]));
                    seen.unwrap();
                    let took = start.elapsed();
                    let of_owner = links[rank].whole.iter().filter(|receipt| receipt.owner == node.vector);
                    let earliest_s = f64::from(round) * exchange_s + of_owner.map(done).fold(0.0, f64::max);
                    assert!(took.as_secs_f64() >= earliest_s, "{kind}, round {round}: {took:?} < {earliest_s} s");
                }
            }
            start.elapsed().as_secs_f64()
        });
        let (slowest_s, rounds_s) = (took.into_iter().fold(0.0, f64::max), f64::from(ROUNDS) * plan.cost.total_s);
        assert!(plan.cost.total_s >= 0.012 && slowest_s >= rounds_s, "{kind}: {slowest_s} s");
        println!("{kind}: {ROUNDS} rounds, modelled {:.2} ms, took {:.2} ms", rounds_s * 1e3, slowest_s * 1e3);
    }
}

#[test]
fn a_straggler_delays_what_is_behind_it() {
    let topology = slow_tree(4);
    let plan = plan(ScheduleKind::Direct, &topology, BYTES).unwrap();
    let links = RankLinks::of(&topology, &plan, BYTES, &no_halo(4));
    let late = Duration::from_millis(80);
    on_ranks(&topology, &plan, &no_halo(4), PATIENT, |transport| {
        let rank = transport.rank();
        let straggler = plan.schedule.queues[0][0].vector;
        let start = Instant::now();
        transport.barrier().unwrap();
        if rank == straggler {
            std::thread::sleep(late);
        }
        publish(transport, 1.0);
        for (node, receipt) in plan.schedule.queues[rank].iter().zip(&links[rank].whole) {
            transport.finish(node.vector, &mut |_| {}).unwrap();
            if rank == 0 {
                assert!(start.elapsed() >= late, "{receipt:?}");
            }
        }
        if rank == 0 {
            let behind_s: f64 = links[0].whole.last().map_or(0.0, |last| last.done.full_s - last.start.full_s);
            assert!(start.elapsed().as_secs_f64() >= late.as_secs_f64() + behind_s);
        }
        transport.barrier().unwrap();
    });
}

#[test]
fn what_is_held_longer_than_the_deadline_times_out_and_what_nobody_reads_is_not_held() {
    // A sub-vector takes 12 s here.
    let topology = Topology::balanced_tree(2, 1e-6, 10.0, Duplex::Full).unwrap();
    let plan = plan(ScheduleKind::Direct, &topology, BYTES).unwrap();
    assert!(plan.cost.total_s > 11.0);
    let halo = Traffic { published: vec![12.0; 2], received: vec![vec![0.0, 12.0], vec![12.0, 0.0]] };
    let deadline = Duration::from_secs(10);
    on_ranks(&topology, &plan, &halo, deadline, |transport| {
        let other = 1 - transport.rank();
        // One row of halo takes 12 ms, two vectors of it twice as long.
        let (start, mut rows) = (Instant::now(), 0.0);
        for vectors in [1, 2] {
            let pattern = halo_of_two(transport.rank(), 1);
            transport.start(&pattern, 3 * vectors, &mut |out| out.fill(1.0)).unwrap();
            transport.finish(other, &mut |message| assert_eq!(message.row(0).len(), 3 * vectors)).unwrap();
            rows += vectors as f64;
            assert!(start.elapsed().as_secs_f64() >= 0.012 * rows);
        }
    });
    on_ranks(&topology, &plan, &no_halo(2), deadline, |transport| {
        let pattern = halo_of_two(transport.rank(), 0);
        transport.start(&pattern, 3, &mut |_| panic!("nobody reads it")).unwrap();
        assert!(pattern.sources().is_empty());
    });
    on_ranks(&topology, &plan, &no_halo(2), Duration::from_millis(200), |transport| {
        let other = 1 - transport.rank();
        publish(transport, 1.0);
        match transport.finish(other, &mut |_| {}) {
            Err(TransportError::TimedOut { source_rank, waited_s, .. }) => {
                assert!(source_rank == other && waited_s >= 0.2);
            }
            other => panic!("{other:?}"),
        }
    });
}

#[test]
fn a_run_keeps_its_bits_and_takes_its_time() {
    let place = Place::new();
    place.write("flag.toml", flag(1000, 2, 2));
    let fast = std::fs::read_to_string(repository("topology/pcie_4.toml")).unwrap();
    assert_eq!(fast.matches("bandwidth_gb_s = 12.0").count(), 6);
    place.write("slow.toml", fast.replace("bandwidth_gb_s = 12.0", "bandwidth_gb_s = 0.02"));
    let common = "run flag.toml --executor cpu --threads 1 --workers 4 --topology slow.toml --schedule ring";
    for exchange in ["halo", "full"] {
        place.run(&format!("{common} --exchange {exchange} --out plain_{exchange}")).expect(0);
        place.run(&format!("{common} --exchange {exchange} --emulate-links --out held_{exchange}")).expect(0);
        assert_eq!(place.hashes(&format!("plain_{exchange}")), place.hashes(&format!("held_{exchange}")));
    }
    let report = place.report("held_full");
    assert_eq!(report["topology"], "slow.toml (links emulated)");
    let vertices = report["vertices"].as_f64().unwrap();
    // Three sub-vectors one after the other over each rank's own link.
    let exchange_s = 3.0 * (vertices / 4.0).floor() * 12.0 / 0.02e9;
    let steps = report["steps"].as_array().unwrap();
    let sum = |value: &dyn Fn(&serde_json::Value) -> Option<f64>| steps.iter().map(|s| value(s).unwrap()).sum::<f64>();
    let (iterations, total_s) = (sum(&|s| s["iterations"].as_f64()), sum(&|s| s["stage_seconds"]["total"].as_f64()));
    assert!(iterations >= steps.len() as f64 && total_s >= iterations * exchange_s, "{total_s} s, {iterations}");
    let error = place.run("run flag.toml --executor cpu --workers 2 --emulate-links --out none").expect(2);
    assert!(error.error().contains("--emulate-links needs") && error.error().contains("--topology FILE"));
    assert!(!place.path("none").exists());
}
