//! Sewing patterns in the JSON of GarmentCode [Korosteleva and Sorkine-Hornung 2023]: panels with straight, Bezier and
//! circular edges, where they hang in space, and which edges are sewn. A pattern becomes a mesh with seams at any
//! resolution.
//!
//! `pattern.panels.NAME`: `vertices` (2D), `edges` (a closed loop of `endpoints` with an optional `curvature`),
//! `translation`, `rotation` (degrees; about x, then y, then z). `pattern.stitches`: pairs of `{ panel, edge }`.
//! Lengths are in `properties.units_in_meter`-ths of a meter. A point is placed at R p + t, the panel in its xy plane.
//! The outside of a panel is where its loop runs counter-clockwise.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::path::Path;

use crate::math::{DQuat, DVec2, DVec3};
use crate::mesh::{FileMesh, FileSeam, Part, SewnMesh, TriangleMesh, panel_mesh};

use super::SceneError;
use super::files::read_text;
use super::json::{Json, parse_json};

/// Straight pieces that a curved edge is measured by.
const PIECES: usize = 256;
/// Distance in space at which paired vertices lie at one place, meters.
const TOUCHING_M: f64 = 1e-5;
/// Gap between panels in the pattern that frames show, meters.
const APART_M: f64 = 0.05;

/// A pattern.
#[derive(Clone, Debug)]
pub(super) struct Pattern {
    panels: Vec<Panel>,
    /// Panel and edge of both sides.
    stitches: Vec<[[usize; 2]; 2]>,
}

#[derive(Clone, Debug)]
struct Panel {
    name: String,
    /// Every edge as a line of short pieces, from end to end, in the order of the loop, meters.
    edges: Vec<Vec<DVec2>>,
    rotation: DQuat,
    translation_m: DVec3,
    /// Twice the area, positive if the loop runs counter-clockwise.
    doubled_area_m2: f64,
}

/// True if a mesh file is a pattern.
pub(super) fn is_pattern(name: &str) -> bool {
    name.to_ascii_lowercase().ends_with(".json")
}

impl Pattern {
    /// Reads a pattern.
    pub(super) fn read(path: &Path) -> Result<Pattern, SceneError> {
        let value = parse_json(&read_text(path)?, path)?;
        let root = Json::root(path, &value);
        let unit_m = match root.get("properties") {
            Some(properties) => 1.0 / properties.or("units_in_meter", 100.0, Json::positive)?,
            None => 0.01,
        };
        let pattern = root.required("pattern")?;
        let list = pattern.required("panels")?;
        let table = list.value.as_object().ok_or_else(|| list.error("must be a table of panels"))?;
        let mut panels = Vec::with_capacity(table.len());
        for name in table.keys() {
            panels.push(panel(&list.required(name)?, name, unit_m)?);
        }
        if panels.is_empty() {
            return Err(list.error("has no panel"));
        }
        let mut stitches = Vec::new();
        let mut taken: BTreeMap<[usize; 2], usize> = BTreeMap::new();
        for (number, stitch) in pattern.entries("stitches")?.iter().enumerate() {
            let mut sides = Vec::new();
            // Further entries are marks of the pattern's maker.
            for side in stitch.array()?.iter().take(2) {
                let name = side.required("panel")?;
                let found = panels.iter().position(|panel| name.text().is_ok_and(|name| name == panel.name));
                let panel = found.ok_or_else(|| name.error("is no panel of the pattern"))?;
                let edge = side.required("edge")?;
                let at = edge.whole(0)? as usize;
                if at >= panels[panel].edges.len() {
                    let (name, edges) = (&panels[panel].name, panels[panel].edges.len());
                    return Err(edge.error(format!("`{name}` has only {edges} edges (from 0)")));
                }
                if let Some(other) = taken.insert([panel, at], number) {
                    let name = &panels[panel].name;
                    return Err(match other == number {
                        true => edge.error(format!("edge {at} of `{name}` is sewn onto itself")),
                        false => edge.error(format!("edge {at} of `{name}` is in two stitches, {other} and {number}")),
                    });
                }
                sides.push([panel, at]);
            }
            let &[a, b] = &sides[..] else { return Err(stitch.error("must have two sides")) };
            stitches.push([a, b]);
        }
        Ok(Pattern { panels, stitches })
    }

    /// Area of all panels, m^2.
    pub(super) fn area_m2(&self) -> f64 {
        self.panels.iter().map(|panel| 0.5 * panel.doubled_area_m2.abs()).sum()
    }

    /// Lowest and highest corner of the box around all panels, meters.
    pub(super) fn bounds(&self) -> [DVec3; 2] {
        let points = self.panels.iter().flat_map(|panel| panel.edges.iter().flatten().map(|&p| panel.in_space(p)));
        let (low, high) = crate::math::bounds(points);
        [low, high]
    }

    /// The panels with about `triangles` triangles in all, in one group each. Its seams are those of the pattern, and
    /// edge k of panel P has the name `P.k`. None if a panel has too few triangles or its edges cross.
    pub(super) fn mesh(&self, triangles: f64) -> Result<FileMesh, String> {
        let edge_m = (self.area_m2() / triangles / (0.75f64.sqrt() / 2.0)).sqrt();
        let mut pieces: Vec<Vec<usize>> = self
            .panels
            .iter()
            .map(|panel| panel.edges.iter().map(|edge| (length(edge) / edge_m).round().max(1.0) as usize).collect())
            .collect();
        // Both sides of a seam have the number of the longer one.
        for &[[a, i], [b, j]] in &self.stitches {
            let most = pieces[a][i].max(pieces[b][j]);
            (pieces[a][i], pieces[b][j]) = (most, most);
        }
        let mut mesh = TriangleMesh::default();
        let (mut parts, mut edges, mut aside_m) = (Vec::new(), Vec::new(), 0.0);
        // Vertices along every edge.
        let mut along: Vec<Vec<Vec<u32>>> = Vec::new();
        for (panel, pieces) in self.panels.iter().zip(&pieces) {
            let first = mesh.positions.len() as u32;
            let (mut border, mut starts) = (Vec::new(), Vec::new());
            for (edge, &count) in panel.edges.iter().zip(pieces) {
                starts.push(border.len());
                border.extend(evenly(edge, count));
            }
            // A loop that runs clockwise is seen from behind.
            let side = panel.doubled_area_m2.signum();
            let seen: Vec<DVec2> = border.iter().map(|p| DVec2::new(side * p.x, p.y)).collect();
            let meshed = panel_mesh(&seen, edge_m).ok_or_else(|| {
                format!("panel `{}` cannot be meshed with so few triangles, or its edges cross", panel.name)
            })?;
            let low = meshed.points.iter().fold(DVec2::INFINITY, |low, &p| low.min(p));
            let high = meshed.points.iter().fold(DVec2::NEG_INFINITY, |high, &p| high.max(p));
            let at_rest = |p: DVec2| (p - low + DVec2::new(aside_m, 0.0)).as_vec2();
            mesh.positions.extend(meshed.points.iter().map(|p| panel.in_space(DVec2::new(side * p.x, p.y)).as_vec3()));
            let start = mesh.triangles.len() as u32;
            for corners in &meshed.triangles {
                mesh.triangles.push(corners.map(|v| v + first));
                mesh.material_uv.push(corners.map(|v| at_rest(meshed.points[v as usize])));
            }
            aside_m += high.x - low.x + APART_M;
            let triangles = start..mesh.triangles.len() as u32;
            parts.push(Part { object: String::new(), group: panel.name.clone(), triangles });
            let of_edge = |k: usize| {
                let end = starts.get(k + 1).copied().unwrap_or(border.len());
                (starts[k]..=end).map(|i| first + (i % border.len()) as u32).collect::<Vec<u32>>()
            };
            let of_panel: Vec<Vec<u32>> = (0..starts.len()).map(of_edge).collect();
            edges.extend((0..).zip(&of_panel).map(|(k, edge)| (format!("{}.{k}", panel.name), edge.clone())));
            along.push(of_panel);
        }
        // Loops run around the outside of their panels, so sides that are sewn run against each other.
        let seam = |&[[a, i], [b, j]]: &[[usize; 2]; 2]| -> FileSeam {
            let name = format!("{}.{i} - {}.{j}", self.panels[a].name, self.panels[b].name);
            let other = along[b][j].iter().rev().copied().collect();
            (name, [along[a][i].clone(), other])
        };
        let mut seams: Vec<FileSeam> = self.stitches.iter().map(seam).collect();
        close_what_touches(&mut mesh, &mut edges, &mut seams);
        let mut file = FileMesh::from(mesh);
        (file.parts, file.edges, file.seams) = (parts, edges, seams);
        Ok(file)
    }

    /// True if edges are sewn.
    pub(super) fn has_seams(&self) -> bool {
        !self.stitches.is_empty()
    }

    /// Names of all edges.
    pub(super) fn edge_names(&self) -> Vec<String> {
        let names = |panel: &Panel| (0..panel.edges.len()).map(|k| format!("{}.{k}", panel.name)).collect::<Vec<_>>();
        self.panels.iter().flat_map(names).collect()
    }
}

/// Joins the pairs of seams that lie at one place, because panels must not touch at the start, and drops the seams of
/// which nothing else is left.
fn close_what_touches(mesh: &mut TriangleMesh, edges: &mut [(String, Vec<u32>)], seams: &mut Vec<FileSeam>) {
    let at = |v: u32| mesh.positions[v as usize].as_dvec3();
    let pairs = seams.iter().flat_map(|(_, [a, b])| a.iter().zip(b).map(|(&a, &b)| [a, b]));
    let touching: Vec<[u32; 2]> = pairs.filter(|&[a, b]| a != b && at(a).distance(at(b)) < TOUCHING_M).collect();
    let Ok(joined) = SewnMesh::new(mesh, &touching) else { return };
    let renumber = |list: &mut Vec<u32>| list.iter_mut().for_each(|v| *v = joined.vertex_of[*v as usize]);
    edges.iter_mut().for_each(|(_, edge)| renumber(edge));
    seams.iter_mut().flat_map(|(_, sides)| sides).for_each(renumber);
    seams.retain(|(_, [a, b])| a != b);
    *mesh = joined.mesh;
}

impl Panel {
    fn in_space(&self, p: DVec2) -> DVec3 {
        self.rotation * DVec3::new(p.x, p.y, 0.0) + self.translation_m
    }
}

fn panel(fields: &Json, name: &str, unit_m: f64) -> Result<Panel, SceneError> {
    let points: Vec<DVec2> = fields
        .required("vertices")?
        .array()?
        .iter()
        .map(|point| Ok(DVec2::from(point.pair()?) * unit_m))
        .collect::<Result<_, SceneError>>()?;
    let mut edges: Vec<Vec<DVec2>> = Vec::new();
    let (mut first, mut last) = (None, None);
    for edge in fields.required("edges")?.array()? {
        let ends = edge.required("endpoints")?;
        let listed = ends.array()?.iter().map(|end| end.whole(0)).collect::<Result<Vec<u32>, _>>()?;
        let &[i, j] = &listed[..] else { return Err(ends.error("must be an array of 2 vertices")) };
        let point = |i: u32| {
            let what = || ends.error(format!("`{name}` has only {} vertices (from 0)", points.len()));
            points.get(i as usize).copied().ok_or_else(what)
        };
        let (start, end) = (point(i)?, point(j)?);
        if last.is_some_and(|last| last != i) || start == end {
            return Err(ends.error("does not begin where the edge before it ends"));
        }
        first = first.or(Some(i));
        last = Some(j);
        edges.push(curve(&edge, start, end, unit_m)?);
    }
    if edges.len() < 2 || first != last {
        return Err(fields.required("edges")?.error(format!("of `{name}` do not close a loop")));
    }
    let all: Vec<DVec2> = edges.iter().flat_map(|edge| edge[..edge.len() - 1].iter().copied()).collect();
    let next = all.iter().cycle().skip(1);
    let doubled_area_m2: f64 = all.iter().zip(next).map(|(a, b)| a.perp_dot(*b)).sum();
    if doubled_area_m2.abs() < 1e-12 {
        return Err(fields.error(format!("`{name}` has no area")));
    }
    let [x, y, z] = fields.or("rotation", DVec3::ZERO, Json::vector)?.to_array().map(f64::to_radians);
    Ok(Panel {
        name: name.to_owned(),
        edges,
        rotation: DQuat::from_rotation_z(z) * DQuat::from_rotation_y(y) * DQuat::from_rotation_x(x),
        translation_m: fields.or("translation", DVec3::ZERO, Json::vector)? * unit_m,
        doubled_area_m2,
    })
}

/// An edge as short straight pieces.
fn curve(edge: &Json, start: DVec2, end: DVec2, unit_m: f64) -> Result<Vec<DVec2>, SceneError> {
    let Some(curvature) = edge.get("curvature") else { return Ok(vec![start, end]) };
    // Older patterns have one control point of a quadratic curve here.
    let (kind, params) = match curvature.value.is_array() {
        true => ("quadratic", vec![curvature.clone()]),
        false => (curvature.required("type")?.text()?, curvature.required("params")?.array()?),
    };
    let along = end - start;
    let across = DVec2::new(-along.y, along.x);
    let control = |at: usize| -> Result<DVec2, SceneError> {
        let params = params.get(at).ok_or_else(|| curvature.error(format!("a {kind} curve needs more params")))?;
        let [x, y] = params.pair()?;
        Ok(start + along * x + across * y)
    };
    let at = |i: usize| i as f64 / PIECES as f64;
    let bezier = |controls: Vec<DVec2>| {
        let all: Vec<DVec2> = std::iter::once(start).chain(controls).chain([end]).collect();
        let point = |i: usize| {
            let mut level = all.clone();
            while level.len() > 1 {
                level = level.windows(2).map(|pair| pair[0].lerp(pair[1], at(i))).collect();
            }
            level[0]
        };
        let mut points: Vec<DVec2> = (0..=PIECES).map(point).collect();
        (points[0], points[PIECES]) = (start, end);
        points
    };
    match kind {
        "quadratic" => Ok(bezier(vec![control(0)?])),
        "cubic" => Ok(bezier(vec![control(0)?, control(1)?])),
        "circle" => {
            let [radius, large, right] = match &params[..] {
                [radius, large, right] => [radius.positive()?, large.number()?, right.number()?],
                _ => return Err(curvature.error("a circle has the params radius, large_arc and right")),
            };
            let (radius_m, half) = (radius * unit_m, 0.5 * along.length());
            if radius_m < half * (1.0 - 1e-9) {
                return Err(curvature.error(format!("a circle of radius {radius} does not reach from end to end")));
            }
            let height = (radius_m * radius_m - half * half).max(0.0).sqrt();
            // Counter-clockwise around its center, a small arc has the center to its left.
            let (is_large, is_right) = (large != 0.0, right != 0.0);
            let to_center = if is_right != is_large { 1.0 } else { -1.0 };
            let center = (start + end) * 0.5 + across.normalize() * (to_center * height);
            let from = (start - center).to_angle();
            let mut turn = (end - center).to_angle() - from;
            let full = 2.0 * PI;
            turn = if is_right { turn.rem_euclid(full) } else { -(-turn).rem_euclid(full) };
            let mut points: Vec<DVec2> =
                (0..=PIECES).map(|i| center + DVec2::from_angle(from + turn * at(i)) * radius_m).collect();
            (points[0], points[PIECES]) = (start, end);
            Ok(points)
        }
        other => Err(curvature.error(format!("`{other}` is no known curvature; known: quadratic, cubic, circle"))),
    }
}

fn length(line: &[DVec2]) -> f64 {
    line.windows(2).map(|pair| pair[0].distance(pair[1])).sum()
}

/// `count` points evenly along a line, without its end.
fn evenly(line: &[DVec2], count: usize) -> Vec<DVec2> {
    let whole = length(line);
    let (mut at, mut before) = (0, 0.0);
    let mut points = vec![line[0]];
    for i in 1..count {
        let wanted = whole * i as f64 / count as f64;
        while at + 2 < line.len() && before + line[at].distance(line[at + 1]) < wanted {
            before += line[at].distance(line[at + 1]);
            at += 1;
        }
        let piece = line[at].distance(line[at + 1]);
        points.push(line[at].lerp(line[at + 1], ((wanted - before) / piece).clamp(0.0, 1.0)));
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALF_DISC: &str = r#"{ "pattern": { "panels": { "half": {
        "vertices": [[0, 0], [20, 0]],
        "edges": [
            { "endpoints": [0, 1] },
            { "endpoints": [1, 0], "curvature": { "type": "circle", "params": [10, 0, 1] } }],
        "translation": [0, 100, 30], "rotation": [0, 90, 0] } }, "stitches": [] } }"#;

    fn pattern(text: &str) -> Result<Pattern, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.json");
        std::fs::write(&path, text).unwrap();
        Pattern::read(&path).map_err(|error| error.to_string())
    }

    #[test]
    fn a_half_disc_has_its_area_and_place() {
        let read = pattern(HALF_DISC).unwrap();
        assert!((read.area_m2() - 0.5 * PI * 0.01).abs() < 1e-6, "{}", read.area_m2());
        let [low, high] = read.bounds();
        assert!((low - DVec3::new(0.0, 1.0, 0.1)).length() < 1e-9, "{low}");
        assert!((high - DVec3::new(0.0, 1.1, 0.3)).length() < 1e-4, "{high}");
        let mesh = read.mesh(500.0).unwrap();
        assert!((mesh.mesh.triangles.len() as f64 / 500.0 - 1.0).abs() < 0.15, "{}", mesh.mesh.triangles.len());
        assert_eq!(mesh.edge_names(), ["half.0", "half.1"]);
        assert_eq!(crate::mesh::validate(&mesh.mesh), Ok(()));
        // It bulges to the other side, the long way.
        let large = HALF_DISC.replace("[10, 0, 1]", "[12, 1, 1]");
        let (angle, r) = (2.0 * (10.0f64 / 12.0).asin(), 0.12f64);
        let small = 0.5 * r * r * (angle - angle.sin());
        assert!((pattern(&large).unwrap().area_m2() - (PI * r * r - small)).abs() < 1e-5);
    }

    #[test]
    fn mistakes_of_a_pattern_are_named() {
        for (from, to, word) in [
            ("[10, 0, 1]", "[9, 0, 1]", "does not reach from end to end"),
            ("\"circle\"", "\"spiral\"", "`spiral` is no known curvature"),
            ("[1, 0]", "[0, 1]", "does not begin where the edge before it ends"),
            ("[1, 0]", "[1, 2]", "`half` has only 2 vertices"),
            ("\"stitches\": []", "\"stitches\": [[{ \"panel\": \"half\", \"edge\": 0 }]]", "must have two sides"),
            (
                "\"stitches\": []",
                "\"stitches\": [[{ \"panel\": \"half\", \"edge\": 0 }, { \"panel\": \"half\", \"edge\": 0 }]]",
                "edge 0 of `half` is sewn onto itself",
            ),
            (
                "\"stitches\": []",
                "\"stitches\": [[{ \"panel\": \"half\", \"edge\": 0 }, { \"panel\": \"half\", \"edge\": 7 }]]",
                "`half` has only 2 edges",
            ),
        ] {
            assert!(HALF_DISC.contains(from));
            let error = pattern(&HALF_DISC.replacen(from, to, 1)).unwrap_err();
            assert!(error.contains(word), "{error}");
        }
    }
}
