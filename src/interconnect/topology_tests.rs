//! Topology files: the shipped ones, malformed ones, arbitrary bytes and arbitrary graphs.

use std::path::{Path, PathBuf};

use proptest::prelude::*;

use super::{Duplex, Hop, ScheduleKind, Topology, check_schedule, lower_bound, plan};

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

#[test]
fn shipped_topologies_are_valid_and_take_every_schedule() {
    for (file, gpus, root_links) in
        [("pcie_2", 2, 2), ("pcie_4", 4, 2), ("pcie_8", 8, 2), ("pcie_16", 16, 2), ("dgx2_16", 16, 16)]
    {
        let topology = Topology::read(&repository(&format!("topology/{file}.toml"))).unwrap();
        assert_eq!((topology.name(), topology.gpus()), (file, gpus));
        assert!(topology.is_tree(), "{file}");
        assert_eq!(topology.leaf_order(), (0..gpus).collect::<Vec<_>>(), "{file}");
        let root = topology.root().unwrap();
        assert_eq!(topology.links().iter().filter(|link| link.ends.contains(&root)).count(), root_links, "{file}");
        for kind in ScheduleKind::ALL {
            check_schedule(&plan(kind, &topology, 1e6).unwrap().schedule).unwrap();
        }
    }
}

#[test]
fn shipped_pcie_trees_are_the_default_trees() {
    for gpus in [2, 4, 8, 16] {
        let shipped = Topology::read(&repository(&format!("topology/pcie_{gpus}.toml"))).unwrap();
        let default = Topology::default_for(gpus).unwrap();
        for from in 0..gpus {
            for to in 0..gpus {
                let numbers = |topology: &Topology| -> Vec<(f64, f64, Duplex)> {
                    let link = |hop: &Hop| topology.links()[hop.link];
                    let path = topology.path(from, to).iter().map(link);
                    path.map(|link| (link.bandwidth_gb_s, link.latency_us, link.duplex)).collect()
                };
                assert_eq!(numbers(&shipped), numbers(&default), "{from} -> {to} of {gpus}");
            }
        }
    }
}

#[test]
fn default_topologies_exist_for_1_to_512_gpus_only() {
    for gpus in (1..=64).chain([128, 500, 512]) {
        let topology = Topology::default_for(gpus).unwrap();
        assert_eq!((topology.gpus(), topology.leaf_order().len(), topology.is_tree()), (gpus, gpus, true));
    }
    for gpus in [0, 513, usize::MAX] {
        let message = Topology::default_for(gpus).unwrap_err().to_string();
        assert!(message.contains("1 to 512 workers") && message.contains(&gpus.to_string()), "{message}");
    }
}

#[test]
fn a_machine_can_be_used_with_fewer_workers() {
    let eight = Topology::read(&repository("topology/pcie_8.toml")).unwrap();
    let three = eight.with_first_gpus(3).unwrap();
    assert_eq!((three.gpus(), three.path(0, 1).len(), three.path(0, 2).len()), (3, 2, 4));
    check_schedule(&plan(ScheduleKind::Auto, &three, 1e6).unwrap().schedule).unwrap();
    let message = eight.with_first_gpus(9).unwrap_err().to_string();
    assert_eq!(message, "topology pcie_8 has 8 GPUs, so it cannot hold 9 workers: ask for 1 to 8");
}

/// Three GPUs in a row (0 - 1 - 2), wide links, and a narrow bus between all.
fn row_of_gpus(extra: &str, bus: bool) -> Result<Topology, String> {
    let bus_links = "{between=['s','a'],bandwidth_gb_s=5,latency_us=1,duplex='half'},
        {between=['s','b'],bandwidth_gb_s=5,latency_us=1,duplex='half'},
        {between=['s','c'],bandwidth_gb_s=5,latency_us=1,duplex='half'},";
    let (switches, bus_links) = if bus { ("['s']", bus_links) } else { ("[]", "") };
    let text = format!(
        "name='row'\n{extra}\nswitches={switches}\ngpus=[{{id=0,name='a'}},{{id=1,name='b'}},{{id=2,name='c'}}]
        links=[{bus_links}{{between=['a','b'],bandwidth_gb_s=50,latency_us=1,duplex='full'}},
        {{between=['b','c'],bandwidth_gb_s=50,latency_us=1,duplex='full'}}]
        device={{name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}}"
    );
    Topology::parse(text.as_bytes(), "row.toml").map_err(|error| error.to_string())
}

#[test]
fn gpus_pass_transfers_on_only_where_the_file_says_so() {
    let message = row_of_gpus("", false).unwrap_err();
    assert!(message.starts_with("row.toml, line 4: GPU `a` reaches GPU `c` only through other GPUs"), "{message}");
    let path = |topology: &Topology| topology.path(0, 2).iter().map(|hop| hop.link).collect::<Vec<_>>();
    assert_eq!(path(&row_of_gpus("gpus_forward=true", false).unwrap()), [0, 1]);
    // With the bus: over the bus (links 0 and 2), or over the wide links (3 and 4) if GPU b passes transfers on.
    assert_eq!(path(&row_of_gpus("", true).unwrap()), [0, 2]);
    assert_eq!(path(&row_of_gpus("gpus_forward=true", true).unwrap()), [3, 4]);
    assert!(!row_of_gpus("", true).unwrap().is_tree());
}

#[test]
fn malformed_topologies_get_one_sentence() {
    let good = std::fs::read_to_string(repository("topology/pcie_2.toml")).unwrap();
    let line_of = |text: &str| 1 + good[..good.find(text).expect("text of pcie_2.toml")].matches('\n').count();
    let gpu1 = "id = 1, name = \"gpu1\"";
    let link1 = "[\"switch0\", \"gpu1\"], bandwidth_gb_s = 12.0, latency_us = 2.0, duplex = \"full\"";
    let cases: Vec<(&str, &str, String, &str)> = vec![
        (
            "= 12.0, latency",
            "= 0.0, latency",
            at(line_of("[\"switch0\", \"gpu0\"]")),
            "link `switch0` - `gpu0`: bandwidth_gb_s must be within",
        ),
        ("= 12.0, latency", "= -3, latency", at(line_of("[\"switch0\", \"gpu0\"]")), "got -3"),
        ("= 12.0, latency", "= nan, latency", at(line_of("[\"switch0\", \"gpu0\"]")), "bandwidth_gb_s"),
        ("= 12.0, latency", "= inf, latency", at(line_of("[\"switch0\", \"gpu0\"]")), "bandwidth_gb_s"),
        ("= 12.0, latency", "= \"fast\", latency", at(line_of("[\"switch0\", \"gpu0\"]")), "expected f64"),
        (
            "latency_us = 2.0",
            "latency_us = -1.0",
            at(line_of("[\"switch0\", \"gpu0\"]")),
            "latency_us must be within 0",
        ),
        (
            ", duplex = \"full\"",
            ", duplex = \"both\"",
            at(line_of("[\"switch0\", \"gpu0\"]")),
            "`both`, expected `full` or `half`",
        ),
        (", duplex = \"full\"", "", at(line_of("[\"switch0\", \"gpu0\"]")), "missing field `duplex`"),
        (
            ", duplex = \"full\"",
            ", duplex = \"full\", color = 1",
            at(line_of("[\"switch0\", \"gpu0\"]")),
            "unknown field `color`",
        ),
        (
            "[\"switch0\", \"gpu1\"]",
            "[\"switch9\", \"gpu1\"]",
            at(line_of("[\"switch0\", \"gpu1\"]")),
            "no switch or GPU named `switch9`",
        ),
        (
            "[\"switch0\", \"gpu1\"]",
            "[\"gpu1\", \"gpu1\"]",
            at(line_of("[\"switch0\", \"gpu1\"]")),
            "two different nodes",
        ),
        (
            "[\"switch0\", \"gpu1\"]",
            "[\"gpu0\", \"switch0\"]",
            at(line_of("[\"switch0\", \"gpu1\"]")),
            "already linked",
        ),
        ("[\"switch0\", \"gpu1\"]", "[\"gpu1\"]", at(line_of("[\"switch0\", \"gpu1\"]")), "invalid length 1"),
        (
            link1,
            "[\"switch0\", \"gpu0\"], bandwidth_gb_s = 1, latency_us = 1, duplex = \"full\"",
            at(line_of("[\"switch0\", \"gpu1\"]")),
            "already linked",
        ),
        (
            gpu1,
            "id = 2, name = \"gpu1\"",
            at(line_of(gpu1)),
            "GPU `gpu1` has id 2, but the ids of 2 GPUs must be 0 to 1",
        ),
        (gpu1, "id = 0, name = \"gpu1\"", at(line_of(gpu1)), "GPUs `gpu0` and `gpu1` both have id 0"),
        (gpu1, "id = -1, name = \"gpu1\"", at(line_of(gpu1)), "-1"),
        (gpu1, "id = 1, name = \"gpu0\"", at(line_of(gpu1)), "`gpu0` is given twice"),
        (gpu1, "id = 1, name = \"\"", at(line_of(gpu1)), "1 to 64 printable characters"),
        (gpu1, "id = 1, name = \"switch0\"", at(line_of("switches =")), "`switch0` is given twice"),
        ("[\"switch0\"]", "[\"switch0\", \"lost\"]", at(line_of("switches =")), "no links lead to switch `lost`"),
        ("memory_gb = 12.0", "memory_gb = -12.0", at(line_of("[device]")), "device: memory_gb must be within"),
        ("memory_gb = 12.0\n", "", at(line_of("[device]")), "missing field `memory_gb`"),
        ("name = \"pcie_2\"", "name = pcie_2", at(line_of("name = \"pcie_2\"")), "string"),
        ("name = \"pcie_2\"", "nam = \"pcie_2\"", at(line_of("name = \"pcie_2\"")), "unknown field `nam`"),
    ];
    for (from, to, place, expected) in cases {
        let text = good.replacen(from, to, 1);
        assert_ne!(text, good, "`{from}` is not in the file");
        let message = Topology::parse(text.as_bytes(), "broken.toml").unwrap_err().to_string();
        assert!(message.starts_with(&format!("broken.toml{place}: ")), "`{to}`: {message}");
        assert!(message.contains(expected) && !message.contains('\n'), "`{to}`: {message}");
    }
}

fn at(line: usize) -> String {
    format!(", line {line}")
}

#[test]
fn unusable_files_get_one_sentence() {
    let message = |bytes: &[u8]| Topology::parse(bytes, "f").unwrap_err().to_string();
    assert_eq!(message(b"name='a'\n\xff\xfe"), "f, line 2: a topology file must be UTF-8 text");
    assert!(message(b"").contains("missing field `name`"), "{}", message(b""));
    assert!(message(&vec![b'#'; (1 << 20) + 1]).contains("at most 1048576 bytes"));
    let device = "device={name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}";
    let none = message(format!("name='a'\ngpus=[]\n{device}").as_bytes());
    assert_eq!(none, "f: gpus: a topology has 1 to 512 GPUs, this file has 0");
    let gpus: Vec<String> = (0..513).map(|id| format!("{{id={id},name='g{id}'}}")).collect();
    let many = message(format!("name='a'\ngpus=[{}]\n{device}", gpus.join(",")).as_bytes());
    assert_eq!(many, "f: gpus: a topology has 1 to 512 GPUs, this file has 513");
    let apart = message(format!("name='a'\ngpus=[\n{{id=1,name='x'}},\n{{id=0,name='y'}}]\n{device}").as_bytes());
    assert_eq!(apart, "f, line 3: no links lead from GPU `y` to GPU `x`: every GPU must be reachable");
    let missing = Topology::read(Path::new("no/such/topology.toml")).unwrap_err().to_string();
    assert!(missing.starts_with("cannot read topology file no/such/topology.toml: "), "{missing}");
}

#[test]
fn the_example_of_the_documentation_is_valid() {
    let page = std::fs::read_to_string(repository("docs/topology.md")).unwrap();
    let example = page.split("```toml").nth(1).and_then(|rest| rest.split("```").next()).expect("a TOML example");
    let topology = Topology::parse(example.as_bytes(), "docs/topology.md").unwrap();
    assert_eq!((topology.gpus(), topology.path(0, 3).len(), topology.is_tree()), (4, 4, true));
}

proptest! {
    #[test]
    fn arbitrary_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        // Random bytes are no topology: `name`, `gpus` and `device` are required.
        prop_assert!(Topology::parse(&bytes, "f").is_err());
    }

    #[test]
    fn arbitrary_text_never_panics(text in "[a-z0-9=\\[\\]{}\",.'\n _#-]{0,300}") {
        prop_assert!(Topology::parse(text.as_bytes(), "f").is_err());
    }

    /// A valid file with one stretch replaced: an error of one line, or still a topology.
    #[test]
    fn damaged_files_never_panic(at in 0usize..2000, gone in 0usize..40, put in "[0-9a-z\"\\[\\]{}=,.\n-]{0,6}") {
        let mut bytes = std::fs::read(repository("topology/pcie_4.toml")).unwrap();
        let start = at.min(bytes.len());
        let end = (start + gone).min(bytes.len());
        bytes.splice(start..end, put.bytes());
        match Topology::parse(&bytes, "f") {
            Err(error) => prop_assert!(!error.to_string().contains('\n')),
            Ok(topology) => every_schedule_works(&topology)?,
        }
    }

    /// Valid TOML with the right fields and arbitrary values: an error, or a topology on which every schedule works.
    #[test]
    fn arbitrary_graphs_never_panic(
        ids in proptest::collection::vec(0usize..6, 0..6),
        switches in 0usize..4,
        links in proptest::collection::vec((0usize..10, 0usize..10, any::<f64>(), 0.0f64..1e3, any::<bool>()), 0..14),
        forward in any::<bool>(),
    ) {
        let name = |node: usize| if node < 6 { format!("g{node}") } else { format!("s{}", node - 6) };
        let gpus: Vec<String> = ids.iter().map(|id| format!("{{id={id},name='g{id}'}}")).collect();
        let switches: Vec<String> = (0..switches).map(|s| format!("'s{s}'")).collect();
        let links: Vec<String> = links.iter().map(|(a, b, width, latency, full)| format!(
            "{{between=['{}','{}'],bandwidth_gb_s={width:e},latency_us={latency:e},duplex='{}'}}",
            name(*a), name(*b), if *full { "full" } else { "half" })).collect();
        let text = format!(
            "name='x'\ngpus_forward={forward}\nswitches=[{}]\ngpus=[{}]\nlinks=[{}]
            device={{name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}}",
            switches.join(","), gpus.join(","), links.join(","));
        match Topology::parse(text.as_bytes(), "f") {
            Err(error) => prop_assert!(!error.to_string().contains('\n')),
            Ok(topology) => every_schedule_works(&topology)?,
        }
    }

}

proptest! {
    // Schedule `best` searches long where it cannot reach the bound.
    #![proptest_config(ProptestConfig { cases: 40, failure_persistence: None, ..ProptestConfig::default() })]

    /// Connected graphs: a random tree of switches, GPUs at random switches, some links more.
    #[test]
    fn every_connected_graph_takes_every_schedule(
        parents in proptest::collection::vec(any::<usize>(), 0..8),
        homes in proptest::collection::vec(any::<usize>(), 1..12),
        shortcuts in proptest::collection::vec((any::<usize>(), any::<usize>()), 0..4),
        width in 1e-3f64..1e3,
    ) {
        let switches = parents.len() + 1;
        let mut pairs: Vec<(String, String)> = Vec::new();
        for (child, parent) in (1..).zip(&parents) {
            pairs.push((format!("s{child}"), format!("s{}", parent % child)));
        }
        for (gpu, home) in homes.iter().enumerate() {
            pairs.push((format!("g{gpu}"), format!("s{}", home % switches)));
        }
        for (a, b) in &shortcuts {
            let (a, b) = (format!("g{}", a % homes.len()), format!("g{}", b % homes.len()));
            let linked = |(x, y): &(String, String)| (*x == a && *y == b) || (*x == b && *y == a);
            if a != b && !pairs.iter().any(linked) {
                pairs.push((a, b));
            }
        }
        let list = |items: Vec<String>| items.join(",");
        let text = format!(
            "name='x'\nswitches=[{}]\ngpus=[{}]\nlinks=[{}]
            device={{name='d',memory_gb=1,bandwidth_gb_s=1,gflops=1}}",
            list((0..switches).map(|s| format!("'s{s}'")).collect()),
            list((0..homes.len()).map(|g| format!("{{id={g},name='g{g}'}}")).collect()),
            list(pairs.iter().enumerate().map(|(i, (a, b))| format!(
                "{{between=['{a}','{b}'],bandwidth_gb_s={:e},latency_us={i},duplex='full'}}", width * (1 + i % 3) as f64
            )).collect()));
        let topology = Topology::parse(text.as_bytes(), "f").map_err(|error| TestCaseError::fail(error.to_string()))?;
        every_schedule_works(&topology)?;
    }
}

fn every_schedule_works(topology: &Topology) -> Result<(), TestCaseError> {
    let order = topology.leaf_order();
    let mut sorted = order.clone();
    sorted.sort_unstable();
    prop_assert_eq!(sorted, (0..topology.gpus()).collect::<Vec<_>>());
    let auto = plan(ScheduleKind::Auto, topology, 1e6).expect("auto always finds one");
    for kind in ScheduleKind::ALL {
        let Ok(plan) = plan(kind, topology, 1e6) else {
            prop_assert!(kind == ScheduleKind::FatTree && !topology.gpus().is_power_of_two());
            continue;
        };
        prop_assert_eq!(check_schedule(&plan.schedule), Ok(()));
        prop_assert_eq!(plan.pieces.as_ref().map_or(Ok(()), |pieces| pieces.check()), Ok(()));
        prop_assert!(plan.cost.total_s >= lower_bound(topology, 1e6).total_s() * (1.0 - 1e-9));
        prop_assert!(plan.cost.total_s.is_finite() && auto.cost.total_s <= plan.cost.total_s * (1.0 + 1e-8));
    }
    Ok(())
}
