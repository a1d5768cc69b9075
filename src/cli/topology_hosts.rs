//! `loomtree topology detect` under `mpirun` or `srun`: the hosts of the ranks and the measured links between them.

use std::fmt::Write as _;

use super::CliError;
use crate::interconnect::{DeviceModel, MAX_GPUS, Topology};
use crate::transport::{MeasuredLink, MeasuredWorld};

/// Assumed inside a host of which no two ranks could be measured.
const ASSUMED: MeasuredLink = MeasuredLink { latency_us: 1.0, bandwidth_gb_s: 10.0 };

/// The text of a topology file: a GPU per rank below the switch of its host, hosts below one network. `device` stands
/// at every leaf; `device_notes`: what its figures rest on.
///
/// # Errors
/// More ranks than a topology has GPUs.
pub(super) fn text(world: &MeasuredWorld, device: &DeviceModel, device_notes: &[String]) -> Result<String, CliError> {
    let MeasuredWorld { hosts, names, inside, between } = world;
    let ranks = hosts.len();
    if ranks > MAX_GPUS {
        return Err(CliError::bad_input(format!("{ranks} ranks, and a topology has at most {MAX_GPUS} GPUs")));
    }
    let mut notes = Vec::new();
    notes.push(format!("{ranks} ranks on {} hosts, a GPU for each", names.len()));
    notes.push(match inside {
        Some(_) => "links inside a host: measured between two ranks of one, host memory to host memory".to_string(),
        None => "links inside a host: assumed, no host has two ranks".to_string(),
    });
    if names.len() > 1 {
        notes.push(
            "links to the network: measured between the first ranks of two hosts, host memory to host memory".into(),
        );
        notes.push("a path between hosts has the latency that was measured; its two halves are taken as equal".into());
    }
    notes.extend(device_notes.iter().cloned());
    // A path inside a host has two links, a path between hosts four.
    let inner = inside.unwrap_or(ASSUMED);
    let inner = MeasuredLink { latency_us: inner.latency_us / 2.0, ..inner };
    let outer = |measured: &MeasuredLink| MeasuredLink {
        latency_us: ((measured.latency_us - 2.0 * inner.latency_us) / 2.0).max(0.0),
        ..*measured
    };
    // Every other host was measured against host 0, whose link is as fast as the fastest of them.
    let others: Vec<MeasuredLink> = between.iter().flatten().map(outer).collect();
    let own = others.iter().copied().reduce(|a, b| if b.bandwidth_gb_s > a.bandwidth_gb_s { b } else { a });
    let to_network: Vec<MeasuredLink> = own.into_iter().chain(others).collect();

    let quoted = |name: &str| serde_json::Value::from(name).to_string();
    let host_name = |host: usize| {
        // Containers may call all of their hosts the same.
        let same = names.iter().filter(|name| **name == names[host]).count();
        let short: String = names[host].chars().take(40).collect();
        if same > 1 { format!("{short} ({host})") } else { short }
    };
    let mut text = String::from("# Written by `loomtree topology detect`. What it rests on:\n");
    // Writing to a String cannot fail.
    notes.iter().for_each(|note| {
        let _ = writeln!(text, "# - {note}");
    });
    let _ = writeln!(text, "\nname = \"detected\"");
    let switches = (names.len() > 1).then(|| "network".to_string()).into_iter().chain((0..names.len()).map(host_name));
    // A single GPU has no switch.
    let switches: Vec<String> = switches.filter(|_| ranks > 1).map(|name| quoted(&name)).collect();
    let _ = writeln!(text, "switches = [{}]\ngpus = [", switches.join(", "));
    for rank in 0..ranks {
        let host = quoted(&host_name(hosts[rank]));
        let _ = writeln!(text, "    {{ id = {rank}, name = \"rank{rank}\", host = {host} }},");
    }
    let _ = writeln!(text, "]\nlinks = [");
    let mut link = |a: &str, b: &str, MeasuredLink { latency_us, bandwidth_gb_s }: MeasuredLink| {
        let _ = writeln!(
            text,
            "    {{ between = [{}, {}], bandwidth_gb_s = {bandwidth_gb_s:.3}, latency_us = {latency_us:.2}, duplex = \
             \"full\" }},",
            quoted(a),
            quoted(b)
        );
    };
    if names.len() > 1 {
        (0..names.len()).for_each(|host| link("network", &host_name(host), to_network[host]));
    }
    if ranks > 1 {
        hosts.iter().enumerate().for_each(|(rank, &host)| link(&host_name(host), &format!("rank{rank}"), inner));
    }
    let DeviceModel { name, memory_gb, bandwidth_gb_s, gflops, launch_us } = device;
    let _ = writeln!(text, "]\n\n[device]\nname = {}", quoted(name));
    let figures = [("memory_gb", memory_gb), ("bandwidth_gb_s", bandwidth_gb_s), ("gflops", gflops)];
    for (key, value) in figures.into_iter().chain([("launch_us", launch_us)]) {
        let _ = writeln!(text, "{key} = {value:?}");
    }
    // The file must be valid for the other commands.
    Topology::parse(text.as_bytes(), "detected topology").map_err(CliError::bad_input)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_become_switches_below_a_network() {
        let link = |latency_us: f64, bandwidth_gb_s: f64| MeasuredLink { latency_us, bandwidth_gb_s };
        let world = MeasuredWorld {
            hosts: vec![0, 0, 1, 1, 2],
            names: vec!["node7".into(), "box".into(), "box".into()],
            inside: Some(link(2.0, 20.0)),
            between: vec![None, Some(link(12.0, 1.2)), Some(link(22.0, 0.6))],
        };
        let device = DeviceModel {
            name: "processor".into(),
            memory_gb: 8.0,
            bandwidth_gb_s: 25.0,
            gflops: 100.0,
            launch_us: 1.0,
        };
        let text = text(&world, &device, &["memory: told".into()]).unwrap();
        let topology = Topology::parse(text.as_bytes(), "found").unwrap();
        assert_eq!((topology.gpus(), topology.is_tree(), topology.device()), (5, true, &device), "{text}");
        assert_eq!(topology.hosts(), [0, 0, 1, 1, 2]);
        let path = |from: usize, to: usize| -> (f64, f64) {
            let links = topology.path(from, to).iter().map(|hop| &topology.links()[hop.link]);
            links.fold((0.0, f64::INFINITY), |(us, rate), link| (us + link.latency_us, rate.min(link.bandwidth_gb_s)))
        };
        assert_eq!(path(0, 1), (2.0, 20.0));
        assert_eq!(path(1, 3), (12.0, 1.2));
        // The half of host 0 is that of its fastest path.
        assert_eq!(path(0, 4), (1.0 + 5.0 + 10.0 + 1.0, 0.6));
        assert!(text.contains("\"box (1)\"") && text.contains("# - memory: told"), "{text}");
    }

    #[test]
    fn a_world_of_one_process_is_a_gpu() {
        let world = MeasuredWorld { hosts: vec![0], names: vec!["a".into()], inside: None, between: vec![None] };
        let device = DeviceModel { name: "d".into(), memory_gb: 1.0, bandwidth_gb_s: 1.0, gflops: 1.0, launch_us: 0.0 };
        let text = text(&world, &device, &[]).unwrap();
        assert_eq!(Topology::parse(text.as_bytes(), "found").unwrap().gpus(), 1, "{text}");
    }
}
