//! Schedule `best`, the lower bound and the clock from the outside: closed forms of P-Cloth's Eqs. 6-9, contention cases
//! solved by hand, and what `best` reaches on every shipped topology. Everything here is modelled time.

use std::path::{Path, PathBuf};
use std::time::Instant;

use loomtree::cli::schedule::{ScheduleArgs, ScheduleFormat, write_schedule};
use loomtree::interconnect::{
    Demand, Duplex, Pieces, ProductKernels, Schedule, ScheduleKind, Topology, Transfer, TransferPlan, candidates,
    check_schedule, demand_bound_s, direct, fat_tree, lower_bound, modeled_cost, pieces_cost, plan, product_s, ring,
    transfer_times,
};

fn shipped() -> Vec<(PathBuf, Topology)> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("topology");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.retain(|file| file.extension().is_some_and(|extension| extension == "toml"));
    files.sort();
    assert!(files.len() >= 20, "{files:?}");
    files.into_iter().map(|file| (file.clone(), Topology::read(&file).unwrap())).collect()
}

/// A sub-vector of 600,000 rows over the GPUs.
fn sub_vector_bytes(topology: &Topology) -> f64 {
    600_000_f64 / topology.gpus() as f64 * 12.0
}

fn unit_tree(gpus: usize, duplex: Duplex) -> Topology {
    Topology::balanced_tree(gpus, 1.0, 0.0, duplex).unwrap()
}

fn close(found: f64, expected: f64) {
    assert!((found - expected).abs() <= 1e-9 * expected.abs().max(1e-9), "{found} is not {expected}");
}

// --- the clock: Eqs. 6-9 --------------------------------------------------------------------------------------------

/// Receipts of `times[j]` seconds each by rank 0 from ranks 1.. over links of their own, so that T_j is what it is told
/// to be: byte counts differ, rates are 1 GB/s.
fn receipts_of_rank_0(times: &[f64]) -> TransferPlan {
    let receipt = |(j, seconds): (usize, &f64)| Transfer {
        source: j + 1,
        owner: j + 1,
        item: j + 1,
        lane: 0,
        bytes: seconds * 1e9,
    };
    let mut queues = vec![Vec::new(); times.len() + 1];
    queues[0] = times.iter().enumerate().map(receipt).collect();
    TransferPlan { ahead: false, queues }
}

/// (Eq. 6, Eq. 7) by the clock for rank 0 with receipts T and kernels C, C[0] being the own block.
fn both_products(t: &[f64], c: &[f64]) -> (f64, f64) {
    let ranks = t.len() + 1;
    let star = unit_tree(ranks, Duplex::Full);
    let transfers = receipts_of_rank_0(t);
    let order: Vec<Vec<usize>> =
        (0..ranks).map(|rank| if rank == 0 { (1..ranks).collect() } else { Vec::new() }).collect();
    let mut whole = vec![0.0; ranks];
    whole[0] = c.iter().sum();
    let mut blocks = vec![vec![0.0; ranks]; ranks];
    blocks[0].copy_from_slice(c);
    let straightforward = product_s(&star, &transfers, &ProductKernels::Whole(whole), &order).unwrap();
    let pipelined = product_s(&star, &transfers, &ProductKernels::Blocks(blocks), &order).unwrap();
    (straightforward, pipelined)
}

#[test]
fn the_clock_is_equations_6_and_7() {
    let cases: [(&[f64], &[f64]); 4] = [
        (&[3.0, 1.0, 2.0], &[1.0, 2.0, 5.0, 0.5]),
        (&[0.5, 0.25, 4.0], &[2.0, 1.0, 1.0, 3.0]),
        (&[1.0], &[0.25, 8.0]),
        (&[2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0], &[1.0, 3.0, 1.0, 3.0, 1.0, 3.0, 1.0, 3.0]),
    ];
    for (t, c) in cases {
        // Eq. 6.
        let sum: f64 = t.iter().sum::<f64>() + c.iter().sum::<f64>();
        // Eq. 7, term by term.
        let (mut s, mut received) = (c[0], 0.0);
        for (t, c) in t.iter().zip(&c[1..]) {
            received += t;
            s = f64::max(s, received) + c;
        }
        let (straightforward, pipelined) = both_products(t, c);
        close(straightforward, sum);
        close(pipelined, s);
    }
}

#[test]
fn the_limits_of_equation_7_are_equations_8_and_9() {
    // Eq. 8: transfers cost nothing beside kernels. Eq. 9: every receipt ends after the kernel before it.
    close(both_products(&[0.1, 0.1, 0.1], &[1.0, 2.0, 3.0, 4.0]).1, 10.0);
    close(both_products(&[5.0, 6.0, 7.0], &[1.0, 2.0, 3.0, 4.0]).1, 18.0 + 4.0);
}

// --- the clock: contention solved by hand ---------------------------------------------------------------------------

#[test]
fn two_receipts_across_one_root_take_turns_by_halves() {
    // 0 <- 2 (2 GB) and 1 <- 3 (1 GB) share the root at 1/2 GB/s each: 1 <- 3 ends at 2 s, then 0 <- 2 has 1 GB left.
    let transfer = |source, bytes| Transfer { source, owner: source, item: source, lane: 0, bytes };
    let queues = vec![vec![transfer(2, 2e9)], vec![transfer(3, 1e9)], Vec::new(), Vec::new()];
    let spans = transfer_times(&TransferPlan { ahead: false, queues }, &unit_tree(4, Duplex::Full));
    close(spans[1][0].done_s, 2.0);
    close(spans[0][0].done_s, 3.0);
}

#[test]
fn a_rank_hands_on_only_what_has_arrived() {
    // v2 goes 2 -> 0 -> 1 on a tree with 0.5 s per link: it is at 0 after 1 + 2 s (four links), at 1 after 1 + 1 s more.
    let tree = Topology::balanced_tree(4, 1.0, 5e5, Duplex::Full).unwrap();
    let transfer = |source| Transfer { source, owner: 2, item: 2, lane: 0, bytes: 1e9 };
    let queues = vec![vec![transfer(2)], vec![transfer(0)], Vec::new(), Vec::new()];
    let spans = transfer_times(&TransferPlan { ahead: false, queues }, &tree);
    close(spans[0][0].done_s, 3.0);
    close(spans[1][0].start_s, 3.0);
    close(spans[1][0].done_s, 5.0);
}

#[test]
fn a_halo_that_is_handed_on_carries_the_rows_of_those_behind() {
    // Ring of 3: rank 2 gets v0 through rank 1. 100 B for rank 1 itself, 50 B for rank 2, at most 120 B published.
    let halo = vec![vec![0.0, 100.0, 50.0], vec![0.0; 3], vec![0.0; 3]];
    let plan = TransferPlan::halo_of_schedule(&ring(3), &halo, &[120.0, 0.0, 0.0]);
    let bytes =
        |rank: usize| plan.queues[rank].iter().map(|transfer| (transfer.source, transfer.bytes)).collect::<Vec<_>>();
    assert_eq!((bytes(0), bytes(1), bytes(2)), (vec![], vec![(0, 120.0)], vec![(1, 50.0)]));
    let plan = TransferPlan::halo_of_schedule(&direct(3), &halo, &[120.0, 0.0, 0.0]);
    assert_eq!(plan.queues[2][0], Transfer { source: 0, owner: 0, item: 0, lane: 0, bytes: 50.0 });
}

// --- the lower bound ------------------------------------------------------------------------------------------------

#[test]
fn bounds_solved_by_hand() {
    let bound = lower_bound(&unit_tree(8, Duplex::Full), 1e9);
    close(bound.ingress_s, 7.0);
    close(bound.total_s(), 7.0);
    // Half duplex: every GPU's link carries 7 in and its own one out.
    close(lower_bound(&unit_tree(8, Duplex::Half), 1e9).total_s(), 8.0);
    // Two pairs with a link of 1/4 GB/s between: two sub-vectors must cross it each way, 8 s; a GPU takes in 3 s.
    let file =
        b"name='x'\nswitches=['r','l','m']\ngpus=[{id=0,name='a'},{id=1,name='b'},{id=2,name='c'},{id=3,name='d'}]
        links=[{between=['r','l'],bandwidth_gb_s=0.25,latency_us=0,duplex='full'},
        {between=['r','m'],bandwidth_gb_s=0.25,latency_us=0,duplex='full'},
        {between=['l','a'],bandwidth_gb_s=1,latency_us=0,duplex='full'},
        {between=['l','b'],bandwidth_gb_s=1,latency_us=0,duplex='full'},
        {between=['m','c'],bandwidth_gb_s=1,latency_us=0,duplex='full'},
        {between=['m','d'],bandwidth_gb_s=1,latency_us=0,duplex='full'}]
        device={name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}";
    let bound = lower_bound(&Topology::parse(file, "x").unwrap(), 1e9);
    close(bound.ingress_s, 3.0);
    close(bound.cut_s, 8.0);
    assert_eq!(bound.cut_gpus.len(), 2, "{bound:?}");
}

// --- best -----------------------------------------------------------------------------------------------------------

fn check_best(topology: &Topology, bytes: f64) -> (f64, Pieces) {
    let best = plan(ScheduleKind::Best, topology, bytes).unwrap();
    check_schedule(&best.schedule).unwrap();
    let pieces = best.pieces.unwrap();
    pieces.check().unwrap();
    assert_eq!(pieces_cost(&pieces, topology, bytes), best.cost);
    let bound_s = lower_bound(topology, bytes).total_s();
    for plan in candidates(topology, bytes) {
        assert!(plan.cost.total_s >= bound_s * (1.0 - 1e-9), "{} beats the bound", plan.kind);
        assert!(best.cost.total_s <= plan.cost.total_s * (1.0 + 1e-9), "{} beats best", plan.kind);
    }
    (best.cost.total_s / bound_s, pieces)
}

#[test]
fn best_is_within_5_percent_of_the_bound_on_every_shipped_topology() {
    for (file, topology) in shipped() {
        let (ratio, _) = check_best(&topology, sub_vector_bytes(&topology));
        // Two islands behind one slow link each: no candidate keeps that link busy from the first chunk to the last.
        let most = if file.ends_with("two_hosts_2x4.toml") { 1.07 } else { 1.05 };
        assert!((1.0 - 1e-9..=most).contains(&ratio), "{}: {ratio}", file.display());
    }
}

#[test]
fn best_costs_3_7_and_15_sub_vector_times_on_uniform_trees_where_the_paper_costs_4_12_and_32() {
    for (gpus, receipts, paper) in [(4, 3.0, 4.0), (8, 7.0, 12.0), (16, 15.0, 32.0)] {
        let tree = unit_tree(gpus, Duplex::Full);
        let best = plan(ScheduleKind::Best, &tree, 1e9).unwrap();
        assert!(best.cost.total_s <= 1.02 * receipts, "{gpus}: {:?}", best.cost);
        close(modeled_cost(&fat_tree(gpus).unwrap(), &tree, 1e9).total_s, paper);
        // The shipped files, with their latencies.
        for file in [format!("pcie_{gpus}"), format!("pcie4_{gpus}"), format!("pcie5_{gpus}")] {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("topology/{file}.toml"));
            let shipped = Topology::read(&path).unwrap();
            let (ratio, _) = check_best(&shipped, sub_vector_bytes(&shipped));
            assert!(ratio <= 1.02, "{file}: {ratio}");
        }
    }
}

#[test]
fn best_exists_for_every_number_of_gpus_and_64_take_less_than_10_seconds() {
    for gpus in 1..=33 {
        let tree = Topology::default_for(gpus).unwrap();
        let best = plan(ScheduleKind::Best, &tree, sub_vector_bytes(&tree)).unwrap();
        best.pieces.unwrap().check().unwrap_or_else(|fault| panic!("{gpus} GPUs: {fault}"));
    }
    let start = Instant::now();
    let tree = Topology::default_for(64).unwrap();
    let (ratio, _) = check_best(&tree, sub_vector_bytes(&tree));
    assert!(ratio <= 1.05, "{ratio}");
    assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
}

#[test]
fn best_is_the_same_every_time() {
    for (file, topology) in shipped() {
        let bytes = sub_vector_bytes(&topology);
        let [a, b] = [(); 2].map(|()| plan(ScheduleKind::Best, &topology, bytes).unwrap().pieces);
        assert!(a == b, "{}", file.display());
    }
}

#[test]
fn halos_of_unequal_sizes_are_brought_close_to_their_bound() {
    let topology = Topology::default_for(8).unwrap();
    // Neighbours in a chain and one long-range pair; rows of rank 3 are read by three others.
    let mut demands: Vec<Demand> = (0..7)
        .flat_map(|i| [(i, i + 1), (i + 1, i)])
        .map(|(owner, reader)| Demand { owner, bytes: 1e5 * (1 + owner % 3) as f64, readers: vec![reader] })
        .collect();
    demands.push(Demand { owner: 3, bytes: 4e5, readers: vec![0, 5, 6] });
    let (plan, seconds) = TransferPlan::best_for(&topology, &demands);
    close(plan.seconds(&topology), seconds);
    // Every reader gets the bytes of its demands, each item once.
    for rank in 0..8 {
        let wanted: f64 =
            demands.iter().filter(|demand| demand.readers.contains(&rank)).map(|demand| demand.bytes).sum();
        close(plan.queues[rank].iter().map(|transfer| transfer.bytes).sum(), wanted);
        let mut items: Vec<usize> = plan.queues[rank].iter().map(|transfer| transfer.item).collect();
        items.sort_unstable();
        items.dedup();
        assert_eq!(items.len(), plan.queues[rank].len());
    }
    let bound_s = demand_bound_s(&topology, &demands);
    assert!(seconds >= bound_s && seconds <= 1.25 * bound_s + 20e-6, "{seconds} over {bound_s}");
}

#[test]
fn the_schema_knows_every_field_of_the_shipped_files() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("topology");
    let schema = std::fs::read(root.join("topology.schema.json")).unwrap();
    let schema: serde_json::Value = serde_json::from_slice(&schema).unwrap();
    let properties =
        |of: &serde_json::Value| -> Vec<String> { of["properties"].as_object().unwrap().keys().cloned().collect() };
    let (top, device) = (properties(&schema), properties(&schema["properties"]["device"]));
    let link = properties(&schema["$defs"]["link"]);
    for (file, _) in shipped() {
        let text = std::fs::read_to_string(&file).unwrap();
        let table: toml::Table = text.parse().unwrap();
        let links = table.get("links").and_then(toml::Value::as_array);
        let keys_of = |value: &toml::Value| value.as_table().unwrap().keys().cloned().collect::<Vec<_>>();
        let known = table.keys().all(|key| top.contains(key))
            && keys_of(&table["device"]).iter().all(|key| device.contains(key))
            && links.into_iter().flatten().flat_map(keys_of).all(|key| link.contains(&key));
        assert!(known, "{}", file.display());
    }
}

// --- the command ----------------------------------------------------------------------------------------------------

fn output(file: &str, format: ScheduleFormat, svg: Option<PathBuf>) -> String {
    let topology = Path::new(env!("CARGO_MANIFEST_DIR")).join("topology").join(file);
    let args = ScheduleArgs { topology, schedule: ScheduleKind::Best, format, rows: 600_000, explain: true, svg };
    let mut out = Vec::new();
    write_schedule(&args, &mut out).unwrap();
    String::from_utf8(out).unwrap()
}

#[test]
fn json_of_best_is_a_schedule_with_pieces_beside() {
    let text = output("dgx1_8.toml", ScheduleFormat::Json, None);
    check_schedule(&serde_json::from_str::<Schedule>(&text).unwrap()).unwrap();
    #[derive(serde::Deserialize)]
    struct Whole {
        pieces: Pieces,
    }
    let pieces = serde_json::from_str::<Whole>(&text).unwrap().pieces;
    pieces.check().unwrap();
    assert!(pieces.chunks > 1 && pieces.queues[0].iter().any(|piece| piece.lane > 0), "several links into a GPU");
}

#[test]
fn explain_names_the_bound_and_every_ratio() {
    let text = output("pcie_8.toml", ScheduleFormat::Text, None);
    assert!(text.contains("gpu0 must take in 7 sub-vectors"), "{text}");
    // 7 x 75 us and 4 us.
    assert!(text.contains("529.0 us  = 7.05 sub-vector times"), "{text}");
    let line = text.lines().rfind(|line| line.trim_start().starts_with("best")).unwrap();
    assert!(line.ends_with("1.000"), "{line}");
}

#[test]
fn the_picture_shows_every_receipt() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.svg");
    output("pcie_4.toml", ScheduleFormat::Text, Some(path.clone()));
    let svg = std::fs::read_to_string(path).unwrap();
    // 4 ranks x 3 sub-vectors x 2 chunks, each a box with a tooltip.
    assert_eq!(svg.matches("<title>").count(), 24, "{svg}");
    assert!(svg.contains("rank 3") && svg.contains("not measured"), "{svg}");
}
