//! The rules of a valid topology, one function each; a fault names the part that breaks one. Only the reader of the
//! file knows in which line that part stands.

use std::collections::{HashMap, HashSet};

use super::parts::{DeviceModel, Fault, Graph, Link, MAX_GPUS, MAX_LINKS, MAX_NAME_CHARS, MAX_SWITCHES, Place, fault};

pub(super) fn check_name(name: &str) -> Result<(), String> {
    if name.is_empty() || name.chars().count() > MAX_NAME_CHARS || name.chars().any(char::is_control) {
        return Err(format!("a name must have 1 to {MAX_NAME_CHARS} printable characters, got {name:.80?}"));
    }
    Ok(())
}

fn check_range(field: &str, value: f64, least: f64, most: f64, unit: &str) -> Result<(), String> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    Err(format!("{field} must be within {least} and {most} {unit}, got {value}"))
}

pub(super) fn check_device(device: &DeviceModel) -> Result<(), Fault> {
    check_name(&device.name)
        .and_then(|()| check_range("memory_gb", device.memory_gb, 1e-3, 1e6, "GB"))
        .and_then(|()| check_range("bandwidth_gb_s", device.bandwidth_gb_s, 1e-3, 1e6, "GB/s"))
        .and_then(|()| check_range("gflops", device.gflops, 1e-3, 1e9, "Gflop/s"))
        .and_then(|()| check_range("launch_us", device.launch_us, 0.0, 1e6, "us"))
        .or_else(|message| fault(Place::Device, format!("device: {message}")))
}

/// Names of GPUs 0..n-1, if the ids are exactly those.
pub(super) fn names_by_id(gpus: &[(usize, String)]) -> Result<Vec<String>, Fault> {
    let count = gpus.len();
    if count == 0 || count > MAX_GPUS {
        return fault(Place::Whole, format!("gpus: a topology has 1 to {MAX_GPUS} GPUs, this file has {count}"));
    }
    let mut names: Vec<Option<&String>> = vec![None; count];
    for (i, (id, name)) in gpus.iter().enumerate() {
        match names.get_mut(*id) {
            None => {
                return fault(
                    Place::Gpu(i),
                    format!("GPU `{name}` has id {id}, but the ids of {count} GPUs must be 0 to {}", count - 1),
                );
            }
            Some(Some(other)) => {
                return fault(Place::Gpu(i), format!("GPUs `{other}` and `{name}` both have id {id}"));
            }
            Some(slot) => *slot = Some(name),
        }
    }
    Ok(names.into_iter().flatten().cloned().collect())
}

/// The node of every name, if all names are usable and unique.
pub(super) fn check_names(gpus: &[(usize, String)], switches: &[String]) -> Result<HashMap<String, usize>, Fault> {
    if switches.len() > MAX_SWITCHES {
        return fault(
            Place::Whole,
            format!("switches: at most {MAX_SWITCHES} are allowed, this file has {}", switches.len()),
        );
    }
    let named_gpus = gpus.iter().enumerate().map(|(i, (id, name))| (Place::Gpu(i), name, *id));
    let named_switches = switches.iter().enumerate().map(|(i, name)| (Place::Switch(i), name, gpus.len() + i));
    let mut node_of_name = HashMap::new();
    for (place, name, node) in named_gpus.chain(named_switches) {
        if let Err(message) = check_name(name) {
            return fault(place, message);
        }
        if node_of_name.insert(name.clone(), node).is_some() {
            return fault(place, format!("the name `{name}` is given twice, names must be unique"));
        }
    }
    Ok(node_of_name)
}

/// Links with their ends as nodes, if all ends exist, no pair is linked twice and the numbers are usable.
pub(super) fn check_links(
    links: Vec<([String; 2], Link)>,
    node_of_name: &HashMap<String, usize>,
) -> Result<Vec<Link>, Fault> {
    if links.len() > MAX_LINKS {
        return fault(Place::Whole, format!("links: at most {MAX_LINKS} are allowed, this file has {}", links.len()));
    }
    let mut pairs = HashSet::new();
    let mut checked = Vec::with_capacity(links.len());
    for (i, (ends, link)) in links.into_iter().enumerate() {
        let wrong = |message: String| Fault {
            place: Place::Link(i),
            message: format!("link `{}` - `{}`: {message}", ends[0], ends[1]),
        };
        let node = |name: &String| {
            node_of_name.get(name).copied().ok_or_else(|| wrong(format!("there is no switch or GPU named `{name}`")))
        };
        let (a, b) = (node(&ends[0])?, node(&ends[1])?);
        if a == b {
            return Err(wrong("a link must join two different nodes".into()));
        }
        if !pairs.insert((a.min(b), a.max(b))) {
            return Err(wrong("these nodes are already linked: state one link with the sum of the bandwidths".into()));
        }
        check_range("bandwidth_gb_s", link.bandwidth_gb_s, 1e-6, 1e6, "GB/s").map_err(&wrong)?;
        check_range("latency_us", link.latency_us, 0.0, 1e9, "us").map_err(&wrong)?;
        checked.push(Link { ends: [a, b], ..link });
    }
    Ok(checked)
}

pub(super) fn check_connected(graph: &Graph, gpus: &[(usize, String)], switches: &[String]) -> Result<(), Fault> {
    let mut reached = vec![false; graph.nodes];
    reached[0] = true;
    let mut changed = true;
    while changed {
        changed = false;
        for [a, b] in graph.links.iter().map(|link| link.ends) {
            if reached[a] != reached[b] {
                reached[a] = true;
                reached[b] = true;
                changed = true;
            }
        }
    }
    match reached.iter().position(|reached| !reached) {
        None => Ok(()),
        Some(node) if node < graph.gpus => {
            let stated = |wanted: usize| gpus.iter().position(|(id, _)| *id == wanted).unwrap_or(0);
            let (first, lost) = (&gpus[stated(0)].1, stated(node));
            fault(
                Place::Gpu(lost),
                format!("no links lead from GPU `{first}` to GPU `{}`: every GPU must be reachable", gpus[lost].1),
            )
        }
        Some(node) => {
            let switch = node - graph.gpus;
            fault(
                Place::Switch(switch),
                format!("no links lead to switch `{}`: connect it or remove it", switches[switch]),
            )
        }
    }
}
