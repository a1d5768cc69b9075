//! Seams that are added to or taken out of a scene that runs. The checks are those of `[[seam]]`, on the mesh of now.

use std::path::PathBuf;

use super::cloth_source::{ClothSource, Shape, StartVelocity};
use super::error::Place;
use super::handles::ClothHandles;
use super::parsed::LAST_LENGTH;
use super::pieces::Piece;
use super::seam::{JointsOfOne, SeamEnd, SeamShape, SeamSource, SideSelection, SideSource, joints_of_one};
use super::seam_fault::{fault_sentence, panel_of};
use super::seam_file::SewingSource;
use super::{Closing, Fabric, Handles, Scene, SeamEdit, SeamEditShape, Sewing, SideEdit};
use crate::math::Vec3;
use crate::mesh::{Border, EdgeCut, FileMesh, Part, SewnMesh, TriangleMesh};

/// A seam that is added, on the mesh before vertices are added for it.
#[derive(Clone, Debug)]
pub struct AddedSeam {
    /// Its name.
    pub name: String,
    /// The vertices that it joins.
    pub ends: Vec<[SeamEnd; 2]>,
    /// Where its side with fewer vertices gets more.
    pub cuts: Vec<EdgeCut>,
}

impl Scene {
    /// What a seam that is added joins.
    ///
    /// # Errors
    /// A sentence: a side is not there, is not part of the border, or both sides run the same way.
    pub fn added_seam(&self, handles: &Handles, seam: &SeamEdit) -> Result<AddedSeam, String> {
        let known: &[String] = self.sewing.as_ref().map_or(&[], |sewing| &sewing.names);
        let name = match &seam.name {
            Some(name) if known.contains(name) => return Err(format!("a seam is named `{name}` already")),
            Some(name) => name.clone(),
            None => (known.len()..).map(|n| n.to_string()).find(|name| !known.contains(name)).unwrap_or_default(),
        };
        let shape = match &seam.shape {
            SeamEditShape::Sides(sides) => {
                let [a, b] = sides.each_ref().map(|side| side_of(handles, side));
                let side = |select| SideSource { cloth: 0, select };
                SeamShape::Sides([side(a?), side(b?)])
            }
            SeamEditShape::Pairs(cloths, pairs) => {
                let [one, other] = cloths.each_ref().map(|cloth| cloth_of(handles, cloth.as_deref()));
                let (one, other) = (one?, other?);
                let pair = |&[a, b]: &[u32; 2]| Ok([vertex_of(one, a)?, vertex_of(other, b)?]);
                SeamShape::Pairs([0, 0], pairs.iter().map(pair).collect::<Result<_, String>>()?)
            }
        };
        let at = Place { path: PathBuf::from("request"), line: None, field: "a".into() };
        let whole = ClothSource {
            name: "the cloth".into(),
            shape: Shape::Mesh(FileMesh::from(TriangleMesh::default())),
            velocity: StartVelocity::Same(Vec3::ZERO),
            fabric: self.fabrics.first().cloned().unwrap_or_else(|| Fabric::uniform("", 1.0, [1.0; 4], 1.0)),
            friction: None,
            pressure_pa: 0.0,
            wrap: None,
            maps: Vec::new(),
        };
        let mut mesh = FileMesh::from(self.mesh.clone());
        let of_cloth = |cloth: &super::Cloth| Part {
            object: cloth.name.clone(),
            group: String::new(),
            triangles: cloth.triangles.clone(),
        };
        mesh.parts = self.parts.iter().cloned().chain(self.cloths.iter().map(of_cloth)).collect();
        let joints =
            joints_of_one(Piece::of_mesh(&whole, mesh), SeamSource { name: name.clone(), shape, angle: None, at });
        let JointsOfOne { ends, cuts, edges } = joints.map_err(|error| error.what())?;
        if let Some((sewing, (seam, [a, b]))) = self.sewing.as_ref().and_then(|s| Some((s, self.taken(s, &edges)?))) {
            let other = &sewing.names[seam as usize];
            return Err(format!("the edge of vertices {a} and {b} is in two seams, `{other}` and `{name}`"));
        }
        Ok(AddedSeam { name, ends, cuts })
    }

    /// The first of `edges` that an open seam sews already, and the seam.
    fn taken(&self, sewing: &Sewing, edges: &[[u32; 2]]) -> Option<(u32, [u32; 2])> {
        let border = Border::new(&self.mesh);
        let partners = |v: u32| {
            let pairs = sewing.pairs.iter().zip(&sewing.seam_of_pair).filter(move |(pair, _)| pair.contains(&v));
            pairs.map(move |(&[a, b], &seam)| (seam, if a == v { b } else { a }))
        };
        let seam_of = |&[a, b]: &[u32; 2]| {
            let both =
                partners(a).flat_map(|(seam, of_a)| partners(b).map(move |(other, of_b)| (seam, other, of_a, of_b)));
            let mut sewn = both.filter(|&(seam, other, of_a, of_b)| seam == other && border.edge(of_a, of_b).is_some());
            sewn.next().map(|(seam, ..)| seam)
        };
        edges.iter().find_map(|edge| Some((seam_of(edge)?, *edge)))
    }

    /// Adds a seam that joins `pairs`. The threads of all seams begin anew at `start_s`, with the distances at
    /// `positions`; without positions `Scene::restart_threads` must follow.
    ///
    /// # Errors
    /// A sentence: the seams do not make cloth, or pins hold both sides apart.
    pub fn sew(
        &mut self,
        seam: &SeamEdit,
        name: String,
        pairs: impl Iterator<Item = [u32; 2]>,
        start_s: f64,
        positions: Option<&[Vec3]>,
    ) -> Result<(), String> {
        let default = SewingSource::default();
        let mut sewing = self.sewing.take().unwrap_or_else(|| Sewing {
            pairs: Vec::new(),
            names: Vec::new(),
            angles: Vec::new(),
            seam_of_pair: Vec::new(),
            closing: Closing { start_s, close_s: default.close_s, last_m: LAST_LENGTH * default.weld_m },
            first_m: None,
            weld_m: default.weld_m,
            refine: 0,
            gravity_m_s2: self.settings.gravity_m_s2,
        });
        let number = sewing.names.len() as u32;
        let old = sewing.pairs.iter().copied().zip(sewing.seam_of_pair.iter().copied());
        let mut both: Vec<([u32; 2], u32)> = old.collect();
        both.extend(pairs.filter(|[a, b]| a != b).map(|[a, b]| ([a.min(b), a.max(b)], number)));
        both.sort_unstable();
        both.dedup_by_key(|(pair, _)| *pair);
        sewing.names.push(name);
        sewing.angles.push(seam.angle as f32);
        (sewing.pairs, sewing.seam_of_pair) = both.into_iter().unzip();
        self.check_seams(&sewing, positions)?;
        sewing.weld_m = seam.weld_m.unwrap_or(sewing.weld_m);
        let close_s = seam.close_s.unwrap_or(sewing.closing.close_s);
        sewing.closing = Closing { start_s, close_s, last_m: LAST_LENGTH * sewing.weld_m };
        let gap =
            |&[a, b]: &[u32; 2], at: &[Vec3]| at[a as usize].as_dvec3().distance(at[b as usize].as_dvec3()) as f32;
        sewing.first_m = Some(match positions {
            Some(at) => sewing.pairs.iter().map(|pair| gap(pair, at)).collect(),
            None => vec![0.0; sewing.pairs.len()],
        });
        self.sewing = Some(sewing);
        Ok(())
    }

    /// Gives the threads of all seams the lengths that they begin with. Lengths of other seams are left out: a later
    /// note of the same step has those of now.
    pub(super) fn restart_threads(&mut self, gaps_m: &[f32]) {
        if let Some(sewing) = self.sewing.as_mut().filter(|sewing| sewing.pairs.len() == gaps_m.len()) {
            sewing.first_m = Some(gaps_m.to_vec());
        }
    }

    /// Takes a seam out. Without seams panels have their weight again.
    pub(super) fn unsew(&mut self, name: &str) -> Result<(), String> {
        let Some(mut sewing) = self.sewing.take() else { return Err("no seam is open".into()) };
        let has_pairs = |seam: usize| sewing.seam_of_pair.contains(&(seam as u32));
        let open = sewing.names.iter().enumerate().filter(|(seam, _)| has_pairs(*seam));
        let open: Vec<(usize, String)> = open.map(|(seam, name)| (seam, name.clone())).collect();
        let Some((seam, _)) = open.iter().find(|(_, open)| open == name) else {
            let known: Vec<String> = open.into_iter().map(|(_, name)| name).collect();
            return Err(format!("no open seam is named `{name}` ({})", known.join(", ")));
        };
        let stays: Vec<bool> = sewing.seam_of_pair.iter().map(|of| *of as usize != *seam).collect();
        let mut at = stays.iter();
        sewing.pairs.retain(|_| at.next() == Some(&true));
        let mut at = stays.iter();
        sewing.seam_of_pair.retain(|_| at.next() == Some(&true));
        if let Some(first_m) = &mut sewing.first_m {
            let mut at = stays.iter();
            first_m.retain(|_| at.next() == Some(&true));
        }
        match sewing.pairs.is_empty() {
            true => self.settings.gravity_m_s2 = sewing.gravity_m_s2,
            false => self.sewing = Some(sewing),
        }
        Ok(())
    }

    fn check_seams(&self, sewing: &Sewing, positions: Option<&[Vec3]>) -> Result<(), String> {
        let seam_at = |pair: usize| sewing.names[sewing.seam_of_pair[pair] as usize].clone();
        let seam_of = |v: u32| sewing.pairs.iter().position(|pair| pair.contains(&v)).map(seam_at);
        let panel = |triangle: u32| panel_of(&self.parts, &self.cloths, triangle);
        if let Err(fault) = SewnMesh::new(&self.mesh, &sewing.pairs) {
            return Err(fault_sentence(fault, &self.mesh, seam_of, panel, |v| v));
        }
        let held = |v: u32| self.pins.iter().find(|pin| pin.vertex == v);
        for (pair, &[a, b]) in sewing.pairs.iter().enumerate() {
            let (Some(one), Some(other), Some(at)) = (held(a), held(b), positions) else { continue };
            let apart_m = at[a as usize].as_dvec3().distance(at[b as usize].as_dvec3());
            if apart_m > 0.5 * sewing.weld_m || one.motion != other.motion {
                return Err(format!(
                    "seam `{}` joins vertices {a} and {b}, but pins hold both, {apart_m:.3} m apart",
                    seam_at(pair)
                ));
            }
        }
        Ok(())
    }
}

impl Handles {
    /// Checks the names of a seam's sides.
    ///
    /// # Errors
    /// A sentence.
    pub fn check_seam(&self, seam: &SeamEdit) -> Result<(), String> {
        match &seam.shape {
            SeamEditShape::Sides(sides) => sides.iter().try_for_each(|side| side_of(self, side).map(|_| ())),
            SeamEditShape::Pairs(cloths, _) => {
                cloths.iter().try_for_each(|cloth| cloth_of(self, cloth.as_deref()).map(|_| ()))
            }
        }
    }
}

/// The cloth of a side; without a name the only one.
fn cloth_of<'h>(handles: &'h Handles, name: Option<&str>) -> Result<&'h ClothHandles, String> {
    match (name, &handles.cloths[..]) {
        (Some(name), cloths) => Ok(&cloths[handles.cloth(name)?]),
        (None, [only]) => Ok(only),
        (None, _) => {
            Err("the scene has several cloths, so a seam must say which: `cloth` of a side, or `cloths`".into())
        }
    }
}

/// The vertex of now that a number of a cloth's file stands for.
fn vertex_of(cloth: &ClothHandles, number: u32) -> Result<u32, String> {
    if cloth.is_sheet {
        return Err("a side of a sheet is an `edge`: left, right, bottom or top".into());
    }
    let found = cloth.vertices.get(number as usize).copied().filter(|&v| v != u32::MAX);
    found.ok_or_else(|| format!("`{}` has no vertex {number} (they count from 0)", cloth.name))
}

fn side_of(handles: &Handles, side: &SideEdit) -> Result<SideSelection, String> {
    let edge_of = |cloth: &ClothHandles, edge: &str| {
        cloth.edges.iter().find(|(name, _)| name == edge).map(|(_, vertices)| vertices.clone())
    };
    let names = |cloths: &[ClothHandles]| {
        let all: Vec<&str> = cloths.iter().flat_map(|cloth| cloth.edges.iter().map(|(name, _)| &name[..])).collect();
        if all.is_empty() { "their files name none".to_owned() } else { all.join(", ") }
    };
    match side {
        SideEdit::Edge(Some(cloth), edge) => {
            let cloth = cloth_of(handles, Some(cloth))?;
            let known = names(std::slice::from_ref(cloth));
            let missing = || format!("`{}` has no edge named `{edge}` ({known})", cloth.name);
            edge_of(cloth, edge).map(SideSelection::Way).ok_or_else(missing)
        }
        SideEdit::Edge(None, edge) => {
            let mut found: Vec<Vec<u32>> = handles.cloths.iter().filter_map(|cloth| edge_of(cloth, edge)).collect();
            match found.len() {
                1 => Ok(SideSelection::Way(found.remove(0))),
                0 => Err(format!("no cloth has an edge named `{edge}` ({})", names(&handles.cloths))),
                _ => Err(format!("several cloths have an edge named `{edge}`; say which one with `cloth`")),
            }
        }
        SideEdit::Vertices(cloth, numbers) => {
            let cloth = cloth_of(handles, cloth.as_deref())?;
            let vertices = numbers.iter().map(|&number| vertex_of(cloth, number)).collect::<Result<_, _>>()?;
            Ok(SideSelection::Vertices(vertices))
        }
        SideEdit::Frame(vertices) => Ok(SideSelection::Way(vertices.clone())),
    }
}
