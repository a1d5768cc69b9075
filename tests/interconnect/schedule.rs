//! Schedules from the outside: invariants for every size, modelled costs with known answers, golden files, and the
//! `schedule` command. `LOOMTREE_BLESS=1` rewrites the golden files. Topology files are tested inside the library.

use std::path::{Path, PathBuf};

use loomtree::cli::schedule::{ScheduleArgs, ScheduleFormat, write_schedule};
use loomtree::interconnect::{
    Duplex, QueueNode, Schedule, ScheduleFault, ScheduleKind, Topology, check_schedule, direct, fat_tree, modeled_cost,
    plan, ring, root_crossings,
};

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn node(source: usize, vector: usize) -> QueueNode {
    QueueNode { source, vector }
}

// --- invariants -----------------------------------------------------------------------------------------------------

#[test]
fn ring_and_direct_hold_the_invariants_for_every_size() {
    for gpus in 2..=64 {
        check_schedule(&ring(gpus)).unwrap_or_else(|fault| panic!("ring of {gpus}: {fault}"));
        check_schedule(&direct(gpus)).unwrap_or_else(|fault| panic!("direct of {gpus}: {fault}"));
    }
}

#[test]
fn fat_tree_holds_the_invariants_and_has_its_closed_form() {
    for gpus in [1, 2, 4, 8, 16, 32, 64] {
        let schedule = fat_tree(gpus).unwrap();
        check_schedule(&schedule).unwrap_or_else(|fault| panic!("fat tree of {gpus}: {fault}"));
        // The recursion unrolled by hand: the lowest bit of the stage is the width that is crossed in it.
        for (rank, queue) in schedule.queues.iter().enumerate() {
            for (stage, found) in (1usize..).zip(queue) {
                let crossed = stage & stage.wrapping_neg();
                assert_eq!(*found, node(rank ^ crossed, rank ^ stage), "n = {gpus}, rank {rank}, stage {stage}");
            }
        }
    }
}

#[test]
fn fat_tree_of_four_is_figure_4_of_the_paper() {
    let queues = fat_tree(4).unwrap().queues;
    assert_eq!(queues[0], [node(1, 1), node(2, 2), node(1, 3)]);
    assert_eq!(queues[1], [node(0, 0), node(3, 3), node(0, 2)]);
    assert_eq!(queues[2], [node(3, 3), node(0, 0), node(3, 1)]);
    assert_eq!(queues[3], [node(2, 2), node(1, 1), node(2, 0)]);
}

#[test]
fn fat_tree_sends_every_sub_vector_across_the_root_once_in_the_middle_stage() {
    for gpus in [2, 4, 8, 16, 32, 64] {
        let topology = Topology::default_for(gpus).unwrap();
        let crossings = root_crossings(&fat_tree(gpus).unwrap(), &topology).unwrap();
        for (stage, vectors) in (1..).zip(crossings) {
            let mut vectors = vectors;
            vectors.sort_unstable();
            let expected: Vec<usize> = if stage == gpus / 2 { (0..gpus).collect() } else { Vec::new() };
            assert_eq!(vectors, expected, "n = {gpus}, stage {stage}");
        }
    }
}

#[test]
fn ring_crosses_the_root_with_one_transfer_each_way_in_every_stage() {
    let topology = Topology::default_for(8).unwrap();
    let crossings = root_crossings(&ring(8), &topology).unwrap();
    assert!(crossings.len() == 7 && crossings.iter().all(|vectors| vectors.len() == 2), "{crossings:?}");
}

#[test]
fn fat_tree_refuses_what_is_no_power_of_two() {
    for gpus in [0, 3, 6, 63] {
        let message = fat_tree(gpus).unwrap_err().to_string();
        assert!(message.contains("power of two") && message.contains(&gpus.to_string()), "{message}");
    }
}

#[test]
fn one_rank_has_an_empty_queue() {
    let alone = Schedule { gpus: 1, queues: vec![Vec::new()] };
    assert_eq!(fat_tree(1).unwrap(), alone);
    assert_eq!(ring(1), alone);
    assert_eq!(direct(1), alone);
    let planned = plan(ScheduleKind::Auto, &Topology::default_for(1).unwrap(), 1e6).unwrap();
    assert_eq!((planned.schedule, planned.cost.total_s), (alone, 0.0));
}

#[test]
fn every_broken_rule_is_named() {
    let good = fat_tree(4).unwrap();
    let broken = |change: fn(&mut Schedule)| {
        let mut schedule = good.clone();
        change(&mut schedule);
        check_schedule(&schedule).unwrap_err()
    };
    assert_eq!(broken(|s| s.gpus = 5), ScheduleFault::QueueCount { gpus: 5, queues: 4 });
    let short = broken(|s| s.queues[2].truncate(2));
    assert_eq!(short, ScheduleFault::StageCount { rank: 2, expected: 3, stages: 2 });
    let nobody = broken(|s| s.queues[1][0] = QueueNode { source: 4, vector: 0 });
    assert_eq!(nobody, ScheduleFault::NoSuchRank { stage: 1, rank: 1, source_rank: 4, vector: 0, gpus: 4 });
    let twice = broken(|s| s.queues[1][0] = QueueNode { source: 1, vector: 1 });
    assert_eq!(twice, ScheduleFault::SendsTwice { stage: 1, source_rank: 1 });
    let early = broken(|s| s.queues[0].swap(0, 2));
    assert_eq!(early, ScheduleFault::NotHeld { stage: 1, rank: 0, source_rank: 1, vector: 3 });
    let again = broken(|s| s.queues[0][2] = QueueNode { source: 1, vector: 1 });
    assert_eq!(again, ScheduleFault::ReceivedTwice { stage: 3, rank: 0, vector: 1 });
    assert!(again.to_string().contains("stage 3 rank 0 receives v1"), "{again}");
}

#[test]
fn handing_on_in_the_stage_of_receipt_is_not_held() {
    // Rank 1 receives v0 in stage 1 and may not hand it on before stage 2.
    let mut schedule = ring(3);
    schedule.queues[2][0] = node(1, 0);
    let expected = ScheduleFault::NotHeld { stage: 1, rank: 2, source_rank: 1, vector: 0 };
    assert_eq!(check_schedule(&schedule), Err(expected));
}

// --- modelled cost --------------------------------------------------------------------------------------------------

/// A balanced tree on which one sub-vector of 10^9 bytes takes one second per link.
fn unit_tree(gpus: usize, duplex: Duplex) -> Topology {
    Topology::balanced_tree(gpus, 1.0, 0.0, duplex).unwrap()
}

fn units(schedule: &Schedule, topology: &Topology) -> f64 {
    modeled_cost(schedule, topology, 1e9).total_s
}

#[test]
fn costs_on_the_uniform_tree_are_the_known_ones() {
    for (gpus, fat_tree_units, ring_units, root_units) in
        [(2, 1.0, 1.0, 1.0), (4, 4.0, 3.0, 4.0), (8, 12.0, 7.0, 16.0), (16, 32.0, 15.0, 64.0)]
    {
        let tree = unit_tree(gpus, Duplex::Full);
        assert_eq!(units(&fat_tree(gpus).unwrap(), &tree), fat_tree_units, "fat tree of {gpus}");
        assert_eq!(units(&ring(gpus), &tree), ring_units, "ring of {gpus}");
        // Without forwarding (n/2)^2 sub-vectors cross the root each way; ranks that run ahead leave it idle for a while.
        let direct_units = units(&direct(gpus), &tree);
        assert!((root_units..=1.04 * root_units).contains(&direct_units), "direct of {gpus}: {direct_units}");
    }
}

#[test]
fn fat_tree_stage_costs_double_with_the_height_of_the_crossed_switch() {
    let cost = modeled_cost(&fat_tree(8).unwrap(), &unit_tree(8, Duplex::Full), 1e9);
    assert_eq!(cost.stage_s, [1.0, 2.0, 1.0, 4.0, 1.0, 2.0, 1.0]);
}

#[test]
fn the_ring_meets_its_bound_on_every_balanced_tree() {
    for gpus in 2..=64 {
        assert_eq!(units(&ring(gpus), &unit_tree(gpus, Duplex::Full)), (gpus - 1) as f64, "ring of {gpus}");
    }
}

#[test]
fn half_duplex_links_carry_both_directions_one_after_the_other() {
    // Each link of the tree is used once up and once down per stage.
    assert_eq!(units(&ring(4), &unit_tree(4, Duplex::Half)), 6.0);
    assert_eq!(units(&fat_tree(2).unwrap(), &unit_tree(2, Duplex::Half)), 2.0);
}

#[test]
fn latency_is_that_of_the_whole_path_and_bandwidth_that_of_the_narrowest_link() {
    let file = b"name='two'\nswitches=['s','t']\ngpus=[{id=0,name='a'},{id=1,name='b'}]\nlinks=[
        {between=['a','s'],bandwidth_gb_s=4,latency_us=10,duplex='full'},
        {between=['s','t'],bandwidth_gb_s=2,latency_us=20,duplex='full'},
        {between=['t','b'],bandwidth_gb_s=4,latency_us=30,duplex='full'}]
        device={name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}";
    let topology = Topology::parse(file, "two").unwrap();
    let cost = modeled_cost(&ring(2), &topology, 1e6);
    assert!((cost.total_s - (60e-6 + 1e6 / 2e9)).abs() < 1e-15, "{cost:?}");
}

#[test]
fn auto_takes_the_cheapest() {
    let chosen = |topology: &Topology| plan(ScheduleKind::Auto, topology, 1e9).unwrap();
    // All root crossings share one link on a uniform tree: the ring wins, for any number of ranks; without latency nothing
    // is gained by chunks.
    for gpus in 4..=64 {
        let plan = chosen(&unit_tree(gpus, Duplex::Full));
        assert_eq!((plan.kind, plan.cost.total_s), (ScheduleKind::Ring, (gpus - 1) as f64), "n = {gpus}");
    }
    // One switch with a link per GPU: nothing to gain from forwarding; posting transfers ahead hides their latencies.
    let dgx2 = Topology::read(&repository("topology/dgx2_16.toml")).unwrap();
    let best = chosen(&dgx2);
    assert_eq!((best.kind, &best.schedule), (ScheduleKind::Best, &direct(16)));
    let pieces = best.pieces.unwrap();
    assert!(pieces.queues.iter().flatten().all(|piece| piece.source == piece.vector), "nothing is forwarded");
    // A true fat tree with slow first bytes at the root: of the schedules that look at no link, crossing it in one stage
    // only is cheapest; `best` posts the crossings ahead and is cheaper still.
    let fat =
        b"name='fat'\nswitches=['r','l','m']\ngpus=[{id=0,name='a'},{id=1,name='b'},{id=2,name='c'},{id=3,name='d'}]
        links=[{between=['r','l'],bandwidth_gb_s=200,latency_us=1e6,duplex='full'},
        {between=['r','m'],bandwidth_gb_s=200,latency_us=1e6,duplex='full'},
        {between=['l','a'],bandwidth_gb_s=100,latency_us=0,duplex='full'},
        {between=['l','b'],bandwidth_gb_s=100,latency_us=0,duplex='full'},
        {between=['m','c'],bandwidth_gb_s=100,latency_us=0,duplex='full'},
        {between=['m','d'],bandwidth_gb_s=100,latency_us=0,duplex='full'}]
        device={name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}";
    let fat = Topology::parse(fat, "fat").unwrap();
    let mut plans = loomtree::interconnect::candidates(&fat, 1e9);
    plans.sort_by(|a, b| a.cost.total_s.total_cmp(&b.cost.total_s));
    assert_eq!([plans[0].kind, plans[1].kind], [ScheduleKind::Best, ScheduleKind::FatTree]);
    assert_eq!(chosen(&fat).kind, ScheduleKind::Best);
}

#[test]
fn schedules_follow_the_tree_however_the_gpus_are_numbered() {
    // Neighbours below one switch are 0 and 2, and 1 and 3.
    let text = std::fs::read_to_string(repository("topology/pcie_4.toml")).unwrap();
    let text = text.replace("id = 1, name = \"gpu1\"", "id = 2, name = \"gpu1\"");
    let text = text.replace("id = 2, name = \"gpu2\"", "id = 1, name = \"gpu2\"");
    let topology = Topology::parse(text.as_bytes(), "renumbered").unwrap();
    assert_eq!(topology.leaf_order(), [0, 2, 1, 3]);
    for (kind, root_transfers) in [(ScheduleKind::Ring, [2, 2, 2]), (ScheduleKind::FatTree, [0, 4, 0])] {
        let plan = plan(kind, &topology, 1e6).unwrap();
        check_schedule(&plan.schedule).unwrap();
        let crossings = root_crossings(&plan.schedule, &topology).unwrap();
        assert_eq!(crossings.iter().map(Vec::len).collect::<Vec<_>>(), root_transfers, "{kind}");
    }
}

// --- the command ----------------------------------------------------------------------------------------------------

fn output(topology: &Path, schedule: ScheduleKind, format: ScheduleFormat) -> Result<String, loomtree::cli::CliError> {
    let mut out = Vec::new();
    let args =
        ScheduleArgs { topology: topology.to_owned(), schedule, format, rows: 600_000, explain: false, svg: None };
    write_schedule(&args, &mut out)?;
    Ok(String::from_utf8(out).expect("the command writes text"))
}

/// A file with one switch and `gpus` GPUs, for sizes that are not shipped.
fn star_file(gpus: usize) -> tempfile::NamedTempFile {
    let list = |item: &dyn Fn(usize) -> String| (0..gpus).map(item).collect::<Vec<_>>().join(",\n");
    let text = format!(
        "name='star'\nswitches=['s']\ngpus=[{}]\nlinks=[{}]
        device={{name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}}\n",
        list(&|id| format!("{{id={id},name='g{id}'}}")),
        list(&|id| format!("{{between=['s','g{id}'],bandwidth_gb_s=12,latency_us=2,duplex='full'}}")),
    );
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    file
}

#[test]
fn schedules_equal_the_golden_files() {
    let cases = [(2, ScheduleKind::FatTree), (4, ScheduleKind::FatTree), (8, ScheduleKind::FatTree)];
    let cases =
        cases.into_iter().chain([(16, ScheduleKind::FatTree), (3, ScheduleKind::Ring), (4, ScheduleKind::Ring)]);
    for (gpus, kind) in cases.chain([(3, ScheduleKind::Direct), (4, ScheduleKind::Direct)]) {
        let star = star_file(gpus);
        let shipped = repository(&format!("topology/pcie_{gpus}.toml"));
        let topology = if kind == ScheduleKind::FatTree { shipped.as_path() } else { star.path() };
        let found = output(topology, kind, ScheduleFormat::Json).unwrap();
        let parsed: Schedule = serde_json::from_str(&found).expect("the command writes the JSON form of a schedule");
        check_schedule(&parsed).unwrap();
        let golden = repository(&format!("tests/golden/schedule/{kind}_{gpus}.json"));
        if std::env::var_os("LOOMTREE_BLESS").is_some_and(|value| value == "1") {
            std::fs::write(&golden, &found).unwrap();
        }
        let expected = std::fs::read_to_string(&golden).unwrap_or_else(|e| panic!("{}: {e}", golden.display()));
        assert_eq!(found, expected, "{} (LOOMTREE_BLESS=1 rewrites it)", golden.display());
    }
}

#[test]
fn the_table_shows_cells_modelled_times_and_the_root() {
    let text = output(&repository("topology/pcie_4.toml"), ScheduleKind::FatTree, ScheduleFormat::Text).unwrap();
    let words = |head: &str| -> Vec<String> {
        let line = text.lines().find(|line| line.starts_with(head)).unwrap_or_else(|| panic!("no `{head}` in\n{text}"));
        line[head.len()..].split_whitespace().map(str::to_owned).collect()
    };
    assert_eq!(words("rank 0"), ["v1<-1", "v2<-2", "v3<-1"]);
    assert_eq!(words("rank 3"), ["v2<-2", "v1<-1", "v0<-2"]);
    // 150,000 rows of 12 bytes at 12 GB/s = 150 us, twice that across the root; 2 us per link of the path.
    assert_eq!(words("modelled us"), ["154.0", "308.0", "154.0"]);
    assert_eq!(words("cross root"), ["0", "4", "0"]);
    assert!(text.contains("stage 2 crosses the root switch switch0") && text.contains("not measured"), "{text}");
    assert!(text.contains("fat-tree         616.0 us   <- shown above"), "{text}");
}

#[test]
fn the_table_of_one_gpu_and_of_many_is_readable() {
    let one = tempfile::NamedTempFile::new().unwrap();
    let text = "name='one'\ngpus=[{id=0,name='g'}]\ndevice={name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}";
    std::fs::write(one.path(), text).unwrap();
    let table = output(one.path(), ScheduleKind::Auto, ScheduleFormat::Text).unwrap();
    assert!(table.contains("direct (chosen by modelled time): 0 stages"), "{table}");
    let json = output(one.path(), ScheduleKind::Auto, ScheduleFormat::Json).unwrap();
    assert_eq!(serde_json::from_str::<Schedule>(&json).unwrap(), ring(1));

    let table = output(&repository("topology/pcie_16.toml"), ScheduleKind::Auto, ScheduleFormat::Text).unwrap();
    assert!(table.contains("schedule best (chosen by modelled time): 15 stages"), "{table}");
    assert!(table.contains("sub-vectors travel in 2 chunk(s)"), "{table}");
    assert!(table.contains("every stage crosses the root switch switch0"), "{table}");
    assert_eq!(table.lines().filter(|line| line.starts_with("rank 7 ")).count(), 2, "two blocks of stages\n{table}");
    let widest = table.lines().map(str::len).max();
    assert!(widest <= Some(150), "{widest:?}");
}

#[test]
fn bad_input_exits_with_2_and_one_sentence() {
    let star = star_file(3);
    let refused = output(star.path(), ScheduleKind::FatTree, ScheduleFormat::Text).unwrap_err();
    assert_eq!(refused.exit_code, 2);
    let expected = "schedule fat-tree needs a power of two of GPUs and there are 3: use ring, direct, best or auto";
    assert_eq!(refused.to_string(), format!("{}: {expected}", star.path().display()));
    let missing = output(Path::new("no/such.toml"), ScheduleKind::Auto, ScheduleFormat::Json).unwrap_err();
    assert_eq!(missing.exit_code, 2);
}

#[test]
fn arguments_are_those_of_the_contract() {
    #[derive(clap::Parser)]
    struct Command {
        #[command(flatten)]
        args: ScheduleArgs,
    }
    let parse = |line: &str| <Command as clap::Parser>::try_parse_from(line.split(' ')).map(|command| command.args);
    let plain = parse("schedule t.toml").unwrap();
    assert_eq!((plain.schedule, plain.format), (ScheduleKind::Auto, ScheduleFormat::Text));
    let full = parse("schedule t.toml --schedule fat-tree --format json").unwrap();
    assert_eq!((full.schedule, full.format), (ScheduleKind::FatTree, ScheduleFormat::Json));
    let best = parse("schedule t.toml --schedule best --explain --svg s.svg").unwrap();
    assert_eq!((best.schedule, best.explain, best.svg), (ScheduleKind::Best, true, Some("s.svg".into())));
    assert!(parse("schedule t.toml --schedule worst").is_err() && parse("schedule t.toml --rows 0").is_err());
}

/// A reader that has gone, or a full disk.
struct Failing(std::io::ErrorKind);

impl std::io::Write for Failing {
    fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
        Err(self.0.into())
    }
    fn flush(&mut self) -> std::io::Result<()> {
        Err(self.0.into())
    }
}

#[test]
fn a_closed_pipe_is_no_error_and_a_full_disk_is_one() {
    let topology = repository("topology/pcie_2.toml");
    let args = ScheduleArgs {
        topology,
        schedule: ScheduleKind::Auto,
        format: ScheduleFormat::Text,
        rows: 1000,
        explain: false,
        svg: None,
    };
    assert_eq!(write_schedule(&args, &mut Failing(std::io::ErrorKind::BrokenPipe)), Ok(()));
    let full = write_schedule(&args, &mut Failing(std::io::ErrorKind::StorageFull)).unwrap_err();
    assert_eq!(full.exit_code, 1);
    assert!(full.message.starts_with("cannot write the result to stdout: "), "{full}");
}
