//! Seams of a scene, from the sides that a file names to pairs of vertices.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use crate::mesh::{Border, EdgeCut, FileMesh, Meeting, TriangleMesh, ascending, match_sides};

use super::SceneError;
use super::error::Place;
use super::pieces::Piece;
use super::pins::sheet_edge;
use super::seam_chords::chords;

/// A seam as the scene file or the file of a cloth gives it.
#[derive(Clone, Debug)]
pub(super) struct SeamSource {
    pub name: String,
    pub shape: SeamShape,
    /// Dihedral angle at rest of its edges, radians; none: as `[sewing]` has it.
    pub angle: Option<f64>,
    pub at: Place,
}

/// What a seam joins.
#[derive(Clone, Debug)]
pub(super) enum SeamShape {
    /// Two sides from end to end.
    Sides([SideSource; 2]),
    /// Vertices one by one, by their numbers in the files of two cloths.
    Pairs([usize; 2], Vec<[u32; 2]>),
    /// The seams that the file of a cloth has. Lenient: what cannot become cloth is left out.
    OfCloth { cloth: usize, lenient: bool },
}

/// A side of a seam: a way along the border of a cloth.
#[derive(Clone, Debug)]
pub(super) struct SideSource {
    /// Index of the piece.
    pub cloth: usize,
    pub select: SideSelection,
}

/// Selection of the vertices of a side.
#[derive(Clone, Debug)]
pub(super) enum SideSelection {
    /// Vertices by their numbers in the file, from end to end. Between two of them the side goes along the border, on
    /// the shorter of both ways.
    Vertices(Vec<u32>),
    /// An edge that the file names.
    Named(String),
    /// As `Vertices`, from either end.
    Way(Vec<u32>),
}

/// Two vertices that a seam makes one: the cloth of each and its number in the piece.
#[derive(Clone, Copy, Debug)]
pub(super) struct Joint {
    /// Index into the names.
    pub seam: u32,
    pub ends: [(usize, u32); 2],
}

/// Joints of all seams, with the names of the seams.
#[derive(Clone, Debug, Default)]
pub(super) struct Joints {
    pub names: Vec<String>,
    /// By seam: [`SeamSource::angle`].
    pub angles: Vec<Option<f64>>,
    pub joints: Vec<Joint>,
    /// By seam: whether it is left out if it does not make cloth.
    pub lenient: Vec<bool>,
    /// A sentence for every seam of a file that cannot be sewn.
    pub left_out: Vec<String>,
}

/// What a joint's end is before vertices are added.
#[derive(Clone, Copy)]
enum End {
    Vertex(usize, u32),
    /// Index of the cut of a cloth.
    Cut(usize, usize),
}

/// A side as vertices of its piece.
struct Side {
    cloth: usize,
    vertices: Vec<u32>,
    /// Arc length at rest of every vertex, from 0 to 1.
    along: Vec<f64>,
    /// True if the triangles beside the side run from its start to its end.
    ascends: bool,
}

impl Side {
    /// The same side from its other end.
    fn turn(&mut self) {
        self.vertices.reverse();
        self.along.reverse();
        self.along.iter_mut().for_each(|along| *along = 1.0 - *along);
        self.ascends = !self.ascends;
    }
}

/// Finds the joints of the seams, and adds the vertices to the pieces that sides with fewer vertices lack.
///
/// # Errors
/// A side is not part of the border, belongs to two seams, or both sides of a seam run the same way.
pub(super) fn sew(pieces: &mut [Piece], seams: &[SeamSource]) -> Result<Joints, SceneError> {
    let mut work = work(pieces, seams)?;
    work.cut_chords();
    Ok(work.finish())
}

/// An end of a joint on a mesh to which no vertex has been added yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SeamEnd {
    /// A vertex.
    Vertex(u32),
    /// The vertex that will be at a cut, by its number.
    Cut(usize),
}

/// What a seam of one piece joins.
pub(super) struct JointsOfOne {
    pub ends: Vec<[SeamEnd; 2]>,
    /// Where vertices have to be added.
    pub cuts: Vec<EdgeCut>,
    /// The edges along its sides, ascending.
    pub edges: Vec<[u32; 2]>,
}

/// The joints of a seam of one piece.
///
/// # Errors
/// Those of [`sew`].
pub(super) fn joints_of_one(piece: Piece, seam: SeamSource) -> Result<JointsOfOne, SceneError> {
    let (mut pieces, seams) = ([piece], [seam]);
    let mut work = work(&mut pieces, &seams)?;
    let end = |end: End| match end {
        End::Vertex(_, vertex) => SeamEnd::Vertex(vertex),
        End::Cut(_, cut) => SeamEnd::Cut(cut),
    };
    let ends = work.ends.iter().map(|(_, ends)| ends.map(end)).collect();
    let mut edges: Vec<[u32; 2]> = work.seam_of_edge.keys().map(|(_, edge)| *edge).collect();
    edges.sort_unstable();
    Ok(JointsOfOne { ends, cuts: work.cuts.remove(&0).unwrap_or_default(), edges })
}

fn work<'p, 's>(pieces: &'p mut [Piece<'s>], seams: &[SeamSource]) -> Result<Work<'p, 's>, SceneError> {
    let mut work = Work {
        borders: pieces.iter().map(|piece| Border::new(&piece.cloth.mesh)).collect(),
        pieces,
        seam_of_edge: HashMap::new(),
        cuts: BTreeMap::new(),
        ends: Vec::new(),
        names: Vec::new(),
        angles: Vec::new(),
        lenient: Vec::new(),
        left_out: Vec::new(),
    };
    for seam in seams {
        match &seam.shape {
            SeamShape::Sides(sides) => {
                let turns =
                    sides.iter().any(|side| matches!(side.select, SideSelection::Named(_) | SideSelection::Way(_)));
                let mut sides = [work.side(seam, &seam.name, &sides[0])?, work.side(seam, &seam.name, &sides[1])?];
                // A named edge has no direction of its own.
                if turns && sides[0].ascends == sides[1].ascends {
                    sides[1].turn();
                }
                work.join(seam, seam.name.clone(), sides)?;
            }
            SeamShape::Pairs(cloths, pairs) => {
                let number = work.names.len() as u32;
                work.names.push(seam.name.clone());
                work.angles.push(seam.angle);
                for pair in pairs {
                    let mut ends = [End::Vertex(0, 0); 2];
                    for i in 0..2 {
                        ends[i] = End::Vertex(cloths[i], work.vertex(seam, cloths[i], pair[i])?);
                    }
                    work.ends.push((number, ends));
                }
            }
            SeamShape::OfCloth { cloth, lenient } => {
                let of_file = work.pieces[*cloth].cloth.seams.clone();
                for (name, sides) in of_file {
                    let inner = sides.iter().find(|side| !work.is_on_border(*cloth, side)).filter(|_| *lenient);
                    if let Some(side) = inner {
                        let (piece, vertex) = (&work.pieces[*cloth].source.name, side[0]);
                        work.left_out.push(format!(
                            "seam `{name}` of `{piece}` is not sewn: its side from vertex {vertex} is not on a border"
                        ));
                        continue;
                    }
                    let [a, b] =
                        sides.map(|vertices| SideSource { cloth: *cloth, select: SideSelection::Vertices(vertices) });
                    let sides = [work.side(seam, &name, &a)?, work.side(seam, &name, &b)?];
                    let given = work.names.len();
                    if let Err(error) = work.join(seam, name.clone(), sides) {
                        if !lenient {
                            return Err(error);
                        }
                        // Three layers in one seam, as in a pleat.
                        let piece = &work.pieces[*cloth].source.name;
                        let why = error.what();
                        work.left_out.push(format!("seam `{name}` of `{piece}` is not sewn: {why}"));
                        work.names.truncate(given);
                        work.angles.truncate(given);
                    }
                    work.lenient.resize(work.names.len(), false);
                    work.lenient[given..].fill(*lenient);
                }
            }
        }
    }
    Ok(work)
}

struct Work<'p, 's> {
    pieces: &'p mut [Piece<'s>],
    borders: Vec<Border>,
    /// Seam of every edge that a side has taken, by cloth and vertices.
    seam_of_edge: HashMap<(usize, [u32; 2]), u32>,
    /// By cloth.
    cuts: BTreeMap<usize, Vec<EdgeCut>>,
    ends: Vec<(u32, [End; 2])>,
    names: Vec<String>,
    angles: Vec<Option<f64>>,
    lenient: Vec<bool>,
    left_out: Vec<String>,
}

impl Work<'_, '_> {
    /// Whether a way along the border leads from each of these vertices of a file to the next.
    fn is_on_border(&self, cloth: usize, numbers: &[u32]) -> bool {
        let file: &FileMesh = &self.pieces[cloth].cloth;
        let way = |pair: &[u32]| self.borders[cloth].way(file.vertex(pair[0])?, file.vertex(pair[1])?);
        numbers.windows(2).all(|pair| way(pair).is_some())
    }

    fn vertex(&self, seam: &SeamSource, cloth: usize, number: u32) -> Result<u32, SceneError> {
        let piece = &self.pieces[cloth];
        let missing = || format!("`{}` has no vertex {number} (they count from 0)", piece.source.name);
        piece.cloth.vertex(number).ok_or_else(|| seam.at.error(missing()))
    }

    /// Where an edge is, as the end of a sentence.
    fn edge_name(&self, cloth: usize, [a, b]: [u32; 2]) -> String {
        let mesh: &FileMesh = &self.pieces[cloth].cloth;
        let panel = self.borders[cloth].edge(a, b).and_then(|edge| mesh.part_of(edge.triangle));
        let panel = panel.unwrap_or(&self.pieces[cloth].source.name);
        let numbers = [a, b].map(|v| mesh.file_vertex(v));
        format!("the edge of vertices {} and {} of `{panel}`", numbers[0], numbers[1])
    }

    fn side(&self, seam: &SeamSource, name: &str, source: &SideSource) -> Result<Side, SceneError> {
        let cloth = source.cloth;
        let border = &self.borders[cloth];
        let file: &FileMesh = &self.pieces[cloth].cloth;
        let cloth_name = &self.pieces[cloth].source.name;
        let listed = match &source.select {
            SideSelection::Vertices(numbers) | SideSelection::Way(numbers) => numbers.clone(),
            SideSelection::Named(edge) if self.pieces[cloth].sheet.is_some() => {
                self.pieces[cloth].sheet.as_ref().and_then(|sheet| sheet_edge(sheet, edge)).ok_or_else(|| {
                    seam.at.error(format!("a sheet has the edges left, right, bottom and top, not `{edge}`"))
                })?
            }
            SideSelection::Named(edge) => file.edge_named(edge).ok_or_else(|| {
                let known = file.edge_names();
                let known = if known.is_empty() { "its file names none".to_owned() } else { known.join(", ") };
                seam.at.error(format!("`{cloth_name}` has no edge named `{edge}` ({known})"))
            })?,
        };
        if listed.len() < 2 {
            return Err(seam.at.error(format!("a side of seam `{name}` needs at least 2 vertices")));
        }
        let mut vertices = vec![self.vertex(seam, cloth, listed[0])?];
        for pair in listed.windows(2) {
            let [from, to] = [self.vertex(seam, cloth, pair[0])?, self.vertex(seam, cloth, pair[1])?];
            let way = border.way(from, to).filter(|way| way.len() > 1).ok_or_else(|| {
                let [a, b] = [pair[0], pair[1]];
                seam.at.error(format!(
                    "seam `{name}`: vertices {a} and {b} of `{cloth_name}` do not lie on one border of it"
                ))
            })?;
            vertices.extend(&way[1..]);
        }
        let edges: Vec<_> = vertices.windows(2).filter_map(|pair| border.edge(pair[0], pair[1])).collect();
        let total: f64 = edges.iter().map(|edge| edge.length_m).sum();
        let mut along = vec![0.0];
        let mut so_far = 0.0;
        for edge in &edges {
            so_far += edge.length_m;
            along.push(so_far / total.max(f64::MIN_POSITIVE));
        }
        let runs = |pair: &[u32], ascends: bool| ascends == (pair[0] < pair[1]);
        let ascends = runs(&vertices, edges[0].ascends);
        if let Some((pair, _)) =
            vertices.windows(2).zip(&edges).find(|(pair, edge)| runs(pair, edge.ascends) != ascends)
        {
            let edge = self.edge_name(cloth, [pair[0], pair[1]]);
            return Err(seam.at.error(format!("seam `{name}`: a side turns back at {edge}")));
        }
        Ok(Side { cloth, vertices, along, ascends })
    }

    fn join(&mut self, seam: &SeamSource, name: String, sides: [Side; 2]) -> Result<(), SceneError> {
        let number = self.names.len() as u32;
        self.names.push(name);
        self.angles.push(seam.angle);
        let name = |seam: u32| format!("seam `{}`", self.names[seam as usize]);
        let mut taken = Vec::new();
        for side in &sides {
            for pair in side.vertices.windows(2) {
                let edge = ascending([pair[0], pair[1]]);
                let other = self.seam_of_edge.get(&(side.cloth, edge)).copied();
                let own = taken.contains(&(side.cloth, edge));
                if let Some(other) = other.or(own.then_some(number)) {
                    let place = self.edge_name(side.cloth, edge);
                    let what = match other == number {
                        true => format!("{} is sewn onto itself: {place} is there twice", name(number)),
                        false => format!("{place} is in two seams, {} and {}", name(other), name(number)),
                    };
                    return Err(seam.at.error(what));
                }
                taken.push((side.cloth, edge));
            }
        }
        if sides[0].ascends == sides[1].ascends {
            let [a, b] = sides.each_ref().map(|side| self.edge_name(side.cloth, [side.vertices[0], side.vertices[1]]));
            return Err(seam.at.error(format!(
                "the sides of {} run the wrong way: with {a} at {b} it would sew the outside of a panel to the inside \
                 of the other; turn the order of one side around, or a panel over",
                name(number)
            )));
        }
        self.seam_of_edge.extend(taken.into_iter().map(|edge| (edge, number)));
        let [a, b] = &sides;
        let a_has_more = a.vertices.len() >= b.vertices.len();
        let (many, few) = if a_has_more { (a, b) } else { (b, a) };
        let same = Vec::from_iter((0..many.vertices.len()).map(|i| Meeting { many: i, few: i, share: 0.0 }));
        let equal = a.vertices.len() == b.vertices.len();
        for Meeting { many: i, few: j, share } in if equal { same } else { match_sides(&many.along, &few.along) } {
            let one = End::Vertex(many.cloth, many.vertices[i]);
            let other = if share == 0.0 {
                End::Vertex(few.cloth, few.vertices[j])
            } else {
                let cuts = self.cuts.entry(few.cloth).or_default();
                cuts.push(EdgeCut { edge: [few.vertices[j], few.vertices[j + 1]], share });
                End::Cut(few.cloth, cuts.len() - 1)
            };
            self.ends.push((number, [one, other]));
        }
        Ok(())
    }

    /// Adds vertices within panels where seams would lay two edges on each other.
    fn cut_chords(&mut self) {
        let vertex = |end: &End| match *end {
            End::Vertex(cloth, vertex) => Some((cloth, vertex)),
            End::Cut(..) => None,
        };
        let joined = self.ends.iter().filter_map(|(_, [a, b])| Some([vertex(a)?, vertex(b)?]));
        let joined: Vec<[(usize, u32); 2]> = joined.collect();
        let cut = self.cuts.iter().flat_map(|(&cloth, cuts)| cuts.iter().map(move |cut| (cloth, ascending(cut.edge))));
        let cut: BTreeSet<(usize, [u32; 2])> = cut.collect();
        let meshes: Vec<&TriangleMesh> = self.pieces.iter().map(|piece| &piece.cloth.mesh).collect();
        for (cloth, edge) in chords(&meshes, &joined, &cut) {
            // After those that joints have as their ends.
            self.cuts.entry(cloth).or_default().push(EdgeCut { edge, share: 0.5 });
        }
    }

    /// Adds the vertices of all cuts.
    fn finish(self) -> Joints {
        let mut added: BTreeMap<usize, Vec<u32>> = BTreeMap::new();
        for (cloth, cuts) in self.cuts {
            added.insert(cloth, self.pieces[cloth].cut_edges(&cuts));
        }
        let vertex = |end: End| match end {
            End::Vertex(cloth, vertex) => (cloth, vertex),
            End::Cut(cloth, cut) => (cloth, added[&cloth][cut]),
        };
        let joints = self.ends.iter().map(|&(seam, ends)| Joint { seam, ends: ends.map(vertex) }).collect();
        let mut lenient = self.lenient;
        lenient.resize(self.names.len(), false);
        Joints { names: self.names, angles: self.angles, joints, lenient, left_out: self.left_out }
    }
}
