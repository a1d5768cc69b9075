//! Changes of a scene while it runs: `[[change]]` in a scene or in the record of a live run, and requests to a live
//! run, which have the same fields.

use std::path::Path;

use serde::Serialize;
use toml::de::DeTable;
use toml::{Table, Value as TomlValue};

use super::SceneError;
use super::cloth_file::{bending, stretching};
use super::fields::{Fields, Source, Value};
use super::seam_file::angle;
use crate::math::Vec3;

/// Tables and fields of a scene, or of a record of changes.
pub(super) const ROOT_FIELDS: [&str; 13] = [
    "name",
    "resolution",
    "simulation",
    "time",
    "air",
    "fabric",
    "cloth",
    "seam",
    "sewing",
    "pin",
    "obstacle",
    "force",
    "change",
];

/// All fields of a `[[change]]`.
pub(super) const CHANGE_FIELDS: [&str; 26] = [
    "step",
    "do",
    "gravity_m_s2",
    "wind_m_s",
    "air_density_kg_m3",
    "air_drag_kg_m2_s",
    "friction",
    "cloth",
    "obstacle",
    "fabric",
    "of_fabric",
    "density_kg_m2",
    "stretching_n_m",
    "bending_n_m",
    "damping_s",
    "pin",
    "name",
    "a",
    "b",
    "cloths",
    "pairs",
    "close_s",
    "weld_m",
    "angle_deg",
    "times",
    "gaps_m",
];

/// Fields of each kind of change, besides `step` and `do`.
const FIELDS_OF: [(&str, &[&str]); 10] = [
    ("gravity", &["gravity_m_s2"]),
    ("wind", &["wind_m_s", "air_density_kg_m3", "air_drag_kg_m2_s"]),
    ("friction", &["friction", "cloth", "obstacle"]),
    ("fabric", &["cloth", "of_fabric", "fabric", "density_kg_m2", "stretching_n_m", "bending_n_m", "damping_s"]),
    ("unpin", &["pin"]),
    ("sew", &["name", "a", "b", "cloths", "pairs", "close_s", "weld_m", "angle_deg"]),
    ("unsew", &["name"]),
    ("refine", &["times"]),
    ("welded", &[]),
    ("threads", &["gaps_m"]),
];

/// Fields of a side of a seam.
const SIDE_FIELDS: [&str; 4] = ["cloth", "edge", "vertices", "frame_vertices"];

/// Most times that one change divides the triangles of the cloth into four.
const REFINE_MOST: u64 = 5;

/// A change and the step after which it acts.
#[derive(Clone, Debug, PartialEq)]
pub struct Change {
    /// Number of steps that are done when it acts.
    pub step: u32,
    /// What changes.
    pub edit: Edit,
    /// Its fields as they were given, `step` included.
    pub table: Table,
}

/// What a change changes.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
pub enum Edit {
    /// Acceleration of gravity, m/s^2.
    Gravity(Vec3),
    /// Velocity of the air, m/s, and what of its density and drag changes.
    Wind { wind_m_s: Vec3, density_kg_m3: Option<f64>, drag_kg_m2_s: Option<f64> },
    /// Coulomb friction coefficient of some pieces and obstacles.
    Friction { of: Of, friction: f64 },
    /// Properties of the fabric of some pieces.
    Fabric { of: Of, fabric: FabricEdit },
    /// The vertices of this pin are free from now on.
    Unpin { pin: String },
    /// A seam is sewn from now on.
    Sew(Box<SeamEdit>),
    /// A seam is no longer sewn.
    Unsew { name: String },
    /// Every triangle is divided into four, this many times.
    Refine { times: u32 },
    /// Seams were welded here. It notes what the run does by itself, so that a run that goes on later knows its mesh.
    Welded,
    /// Lengths of the threads of all seams, which begin to shorten here, meters. It notes what follows from the state
    /// when a seam is sewn, as [`Edit::Welded`] does.
    Threads { gaps_m: Vec<f32> },
}

impl Edit {
    /// Whether it notes what the run does by itself.
    pub fn is_note(&self) -> bool {
        matches!(self, Edit::Welded | Edit::Threads { .. })
    }
}

/// What a change is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Of {
    /// All pieces, and all obstacles where they have such a property.
    All,
    /// The piece of this name or number.
    Cloth(String),
    /// The obstacle of this name.
    Obstacle(String),
    /// The pieces that have the fabric of this name.
    Fabric(String),
}

/// Properties of a fabric that change.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FabricEdit {
    /// Name of another fabric, whose limits and yield points do not come with it.
    pub fabric: Option<String>,
    /// kg/m^2.
    pub density_kg_m2: Option<f64>,
    /// As [`super::Fabric::stretching_n_m`].
    pub stretching_n_m: Option<[[f64; 4]; 6]>,
    /// As [`super::Fabric::bending_n_m`].
    pub bending_n_m: Option<[[f64; 5]; 3]>,
    /// Seconds.
    pub damping_s: Option<f64>,
}

/// A seam that is added.
#[derive(Clone, Debug, PartialEq)]
pub struct SeamEdit {
    /// Its name; none: a number.
    pub name: Option<String>,
    /// What it joins.
    pub shape: SeamEditShape,
    /// Time until all threads have their last length, seconds; none: as the scene has it.
    pub close_s: Option<f64>,
    /// The gap at which seams count as closed, meters; none: as the scene has it.
    pub weld_m: Option<f64>,
    /// Dihedral angle at rest of its edges, radians.
    pub angle: f64,
}

/// What a seam that is added joins.
#[derive(Clone, Debug, PartialEq)]
pub enum SeamEditShape {
    /// Two sides from end to end.
    Sides([SideEdit; 2]),
    /// Vertices one by one, by their numbers in the files of two cloths.
    Pairs([Option<String>; 2], Vec<[u32; 2]>),
}

/// A side of a seam that is added.
#[derive(Clone, Debug, PartialEq)]
pub enum SideEdit {
    /// An edge of a sheet, or one that the file of a mesh names; without a cloth the only edge of that name.
    Edge(Option<String>, String),
    /// Vertices by their numbers in the file of a cloth, from end to end.
    Vertices(Option<String>, Vec<u32>),
    /// Vertices by their numbers in the frame files of now, from end to end.
    Frame(Vec<u32>),
}

impl Change {
    /// A change from its fields, without `step`.
    ///
    /// # Errors
    /// One sentence with the field that is wrong.
    pub fn of_request(mut table: Table, step: u32) -> Result<Change, String> {
        if table.contains_key("step") {
            return Err("field `step`: a request acts at the next step".into());
        }
        if let Some(note @ ("welded" | "threads")) = table.get("do").and_then(TomlValue::as_str) {
            return Err(format!("field `do`: `{note}` is for records; `refine` and `sew` change the mesh"));
        }
        table.insert("step".into(), i64::from(step).into());
        let text = text_of(std::iter::once(&table)).map_err(|error| error.to_string())?;
        let read = read_changes(&text, Path::new("request")).map_err(|error| error.without_place())?;
        read.into_iter().next().ok_or_else(|| "a request without a change".into())
    }

    /// A note that seams were welded after `step`.
    pub fn welded(step: u32) -> Change {
        Change { step, edit: Edit::Welded, table: note(step, "welded") }
    }

    /// A note that the threads of all seams begin after `step` with these lengths, meters.
    pub fn threads(step: u32, gaps_m: Vec<f32>) -> Change {
        let mut table = note(step, "threads");
        // As f64 every f32 is written with digits that read as the same number.
        let gaps = gaps_m.iter().map(|&gap| TomlValue::from(f64::from(gap))).collect();
        table.insert("gaps_m".into(), TomlValue::Array(gaps));
        Change { step, edit: Edit::Threads { gaps_m }, table }
    }
}

fn note(step: u32, what: &str) -> Table {
    let mut table = Table::new();
    table.insert("step".into(), i64::from(step).into());
    table.insert("do".into(), what.into());
    table
}

/// The text of changes, as a scene or a record holds them.
///
/// # Errors
/// A value that TOML cannot hold.
pub fn changes_text<'c>(changes: impl Iterator<Item = &'c Change>) -> Result<String, String> {
    text_of(changes.map(|change| &change.table)).map_err(|error| error.to_string())
}

fn text_of<'t>(tables: impl Iterator<Item = &'t Table>) -> Result<String, toml::ser::Error> {
    let line = |(key, value): (&String, &TomlValue)| -> Result<String, toml::ser::Error> {
        let mut text = String::new();
        value.serialize(toml::ser::ValueSerializer::new(&mut text))?;
        Ok(format!("{key} = {text}\n"))
    };
    // Tables within a change stay in its lines, because a header of their own would not be one of `[[change]]`.
    let change =
        |table: &Table| Ok(format!("[[change]]\n{}\n", table.iter().map(line).collect::<Result<String, _>>()?));
    tables.map(change).collect()
}

/// The changes in the text of a scene or a record, in the order of their steps.
///
/// # Errors
/// The text is not TOML, or a field is wrong.
pub fn read_changes(text: &str, path: &Path) -> Result<Vec<Change>, SceneError> {
    let source = Source::new(path, text);
    let fault = |what: String| SceneError::Syntax { path: path.into(), line: None, what: what.replace('\n', ", ") };
    let document = DeTable::parse(text).map_err(|error| fault(error.message().into()))?;
    let root = Fields::root(&source, document.get_ref(), &ROOT_FIELDS)?;
    changes(&root, text)
}

/// Reads the `[[change]]` tables of a document, whose text is `text`.
pub(super) fn changes(root: &Fields, text: &str) -> Result<Vec<Change>, SceneError> {
    let fields = root.tables("change", &CHANGE_FIELDS)?;
    if fields.is_empty() {
        return Ok(Vec::new());
    }
    // The same tables once more as values; the text has just been read.
    let values: Table = text.parse().map_err(|error: toml::de::Error| root.error(error.message().to_string()))?;
    let tables = values.get("change").and_then(TomlValue::as_array).cloned().unwrap_or_default();
    let mut changes = Vec::with_capacity(fields.len());
    for (fields, table) in fields.iter().zip(tables) {
        let step = fields.required("step")?.whole(0..=u64::from(u32::MAX - 1))? as u32;
        let TomlValue::Table(table) = table else { continue };
        changes.push(Change { step, edit: edit(fields)?, table });
    }
    // Changes of one step keep their order.
    changes.sort_by_key(|change| change.step);
    Ok(changes)
}

fn edit(fields: &Fields) -> Result<Edit, SceneError> {
    let what = fields.required("do")?;
    let index = what.choice(&std::array::from_fn::<_, { FIELDS_OF.len() }, _>(|i| (FIELDS_OF[i].0, i)))?;
    let (kind, own) = FIELDS_OF[index];
    if let Some(other) = CHANGE_FIELDS.into_iter().skip(2).find(|key| fields.get(key).is_some() && !own.contains(key)) {
        let known = if own.is_empty() { "none".to_owned() } else { own.join(", ") };
        return Err(fields.error_at(other, format!("does not belong to `{kind}`, whose fields are: {known}")));
    }
    let text = |value: &Value| value.text().map(str::to_owned);
    let vector = |value: &Value| Ok(value.vector()?.as_vec3());
    Ok(match kind {
        "gravity" => Edit::Gravity(fields.required("gravity_m_s2").and_then(|value| vector(&value))?),
        "wind" => Edit::Wind {
            wind_m_s: fields.required("wind_m_s").and_then(|value| vector(&value))?,
            density_kg_m3: fields.optional("air_density_kg_m3", Value::not_negative)?,
            drag_kg_m2_s: fields.optional("air_drag_kg_m2_s", Value::not_negative)?,
        },
        "friction" => {
            let of = match (fields.optional("cloth", name_or_number)?, fields.optional("obstacle", text)?) {
                (Some(_), Some(_)) => return Err(fields.error_at("obstacle", "give either `cloth` or `obstacle`")),
                (Some(cloth), None) => Of::Cloth(cloth),
                (None, Some(obstacle)) => Of::Obstacle(obstacle),
                (None, None) => Of::All,
            };
            Edit::Friction { of, friction: fields.required("friction")?.not_negative()? }
        }
        "fabric" => {
            let of = match (fields.optional("cloth", name_or_number)?, fields.optional("of_fabric", text)?) {
                (Some(_), Some(_)) => return Err(fields.error_at("of_fabric", "give either `cloth` or `of_fabric`")),
                (Some(cloth), None) => Of::Cloth(cloth),
                (None, Some(fabric)) => Of::Fabric(fabric),
                (None, None) => Of::All,
            };
            let fabric = FabricEdit {
                fabric: fields.optional("fabric", text)?,
                density_kg_m2: fields.optional("density_kg_m2", Value::positive)?,
                stretching_n_m: fields.optional("stretching_n_m", stretching)?,
                bending_n_m: fields.optional("bending_n_m", bending)?,
                damping_s: fields.optional("damping_s", Value::not_negative)?,
            };
            if fabric == FabricEdit::default() {
                return Err(fields.error("nothing of the fabric changes; give `fabric` or one of its properties"));
            }
            Edit::Fabric { of, fabric }
        }
        "unpin" => Edit::Unpin { pin: name_or_number(&fields.required("pin")?)? },
        "sew" => Edit::Sew(Box::new(seam(fields)?)),
        "unsew" => Edit::Unsew { name: name_or_number(&fields.required("name")?)? },
        "refine" => Edit::Refine { times: fields.or("times", 1, |value| value.whole(1..=REFINE_MOST))? as u32 },
        "threads" => {
            let gap = |value: &Value| Ok(value.not_negative()? as f32);
            let gaps = fields.required("gaps_m")?.array()?;
            Edit::Threads { gaps_m: gaps.iter().map(gap).collect::<Result<_, SceneError>>()? }
        }
        _ => Edit::Welded,
    })
}

/// A name, or a number in place of one.
fn name_or_number(value: &Value) -> Result<String, SceneError> {
    if value.is_text() { value.text().map(str::to_owned) } else { Ok(value.whole(0..=i32::MAX as u64)?.to_string()) }
}

fn vertices(value: &Value) -> Result<Vec<u32>, SceneError> {
    value.array()?.iter().map(|vertex| Ok(vertex.whole(0..=i32::MAX as u64)? as u32)).collect()
}

fn seam(fields: &Fields) -> Result<SeamEdit, SceneError> {
    let shape = match fields.get("pairs") {
        Some(pairs) => {
            if let Some(key) = ["a", "b"].into_iter().find(|key| fields.get(key).is_some()) {
                return Err(fields.error_at(key, "give either `pairs` or both sides, `a` and `b`"));
            }
            let cloths = match fields.get("cloths") {
                None => [None, None],
                Some(value) => {
                    let named = value.array()?.iter().map(name_or_number).collect::<Result<Vec<_>, _>>()?;
                    let [one, other]: [String; 2] =
                        named.try_into().map_err(|_| value.error("must be an array of 2 cloths"))?;
                    [Some(one), Some(other)]
                }
            };
            let pair = |value: &Value| -> Result<[u32; 2], SceneError> {
                vertices(value)?.try_into().map_err(|_| value.error("must be an array of 2 vertices"))
            };
            SeamEditShape::Pairs(cloths, pairs.array()?.iter().map(pair).collect::<Result<_, _>>()?)
        }
        None => {
            if fields.get("cloths").is_some() {
                return Err(fields.error_at("cloths", "belongs to a seam with `pairs`; a side names its own cloth"));
            }
            SeamEditShape::Sides([side(&fields.required("a")?)?, side(&fields.required("b")?)?])
        }
    };
    Ok(SeamEdit {
        name: fields.optional("name", name_or_number)?,
        shape,
        close_s: fields.optional("close_s", Value::positive)?,
        weld_m: fields.optional("weld_m", Value::positive)?,
        angle: fields.or("angle_deg", 0.0, angle)?,
    })
}

fn side(value: &Value) -> Result<SideEdit, SceneError> {
    if value.is_text() {
        return Ok(SideEdit::Edge(None, value.text()?.to_owned()));
    }
    let fields = value.table(&SIDE_FIELDS)?;
    let cloth = fields.optional("cloth", name_or_number)?;
    match (fields.get("edge"), fields.get("vertices"), fields.get("frame_vertices")) {
        (Some(edge), None, None) => Ok(SideEdit::Edge(cloth, edge.text()?.to_owned())),
        (None, Some(list), None) => Ok(SideEdit::Vertices(cloth, vertices(&list)?)),
        (None, None, Some(list)) if cloth.is_none() => Ok(SideEdit::Frame(vertices(&list)?)),
        (None, None, Some(_)) => {
            Err(fields.error_at("cloth", "does not go with `frame_vertices`, which count all cloths"))
        }
        _ => Err(fields.error("a side needs one of `edge`, `vertices` and `frame_vertices`")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(text: &str) -> Result<Edit, String> {
        Change::of_request(text.parse().unwrap(), 7).map(|change| {
            assert_eq!(change.step, 7);
            // What is recorded reads as the same.
            let again = read_changes(&changes_text(std::iter::once(&change)).unwrap(), Path::new("x.toml")).unwrap();
            assert_eq!(again, [change.clone()]);
            change.edit
        })
    }

    #[test]
    fn every_kind_is_read_and_recorded() {
        let gravity = request("do = \"gravity\"\ngravity_m_s2 = [0, -1.5, 0]").unwrap();
        assert_eq!(gravity, Edit::Gravity(Vec3::new(0.0, -1.5, 0.0)));
        let wind = request("do = \"wind\"\nwind_m_s = [3, 0, 0.1]\nair_drag_kg_m2_s = 0.2").unwrap();
        let calm = Edit::Wind { wind_m_s: Vec3::new(3.0, 0.0, 0.1), density_kg_m3: None, drag_kg_m2_s: Some(0.2) };
        assert_eq!(wind, calm);
        let friction = request("do = \"friction\"\ncloth = 1\nfriction = 0.1").unwrap();
        assert_eq!(friction, Edit::Friction { of: Of::Cloth("1".into()), friction: 0.1 });
        let Edit::Fabric { of, fabric } = request("do = \"fabric\"\nof_fabric = \"silk\"\nbending_n_m = 1e-5").unwrap()
        else {
            panic!("a fabric")
        };
        assert_eq!((of, fabric.bending_n_m), (Of::Fabric("silk".into()), Some([[1e-5; 5]; 3])));
        assert_eq!(request("do = \"unpin\"\npin = 0").unwrap(), Edit::Unpin { pin: "0".into() });
        assert_eq!(request("do = \"refine\"").unwrap(), Edit::Refine { times: 1 });
        let Edit::Sew(seam) =
            request("do = \"sew\"\na = \"left\"\nb = { cloth = \"back\", vertices = [3, 4] }\nclose_s = 0.2").unwrap()
        else {
            panic!("a seam")
        };
        let sides = [SideEdit::Edge(None, "left".into()), SideEdit::Vertices(Some("back".into()), vec![3, 4])];
        assert_eq!((seam.shape, seam.close_s), (SeamEditShape::Sides(sides), Some(0.2)));
    }

    #[test]
    fn lengths_of_threads_keep_their_bits() {
        let gaps: Vec<f32> = vec![0.1, 1.0 / 3.0, 1e-7, f32::MIN_POSITIVE, 0.0];
        let threads = Change::threads(9, gaps);
        let again = read_changes(&changes_text(std::iter::once(&threads)).unwrap(), Path::new("x.toml")).unwrap();
        assert_eq!(again, [threads]);
    }

    #[test]
    fn faults_are_sentences_with_the_field() {
        for (text, sentence) in [
            ("", "field `change.do`: is missing"),
            ("do = \"grow\"", "must be one of gravity, wind"),
            ("do = \"gravity\"", "field `change.gravity_m_s2`: is missing"),
            ("do = \"gravity\"\ngravity_m_s2 = [0, 1]", "must be an array of 3 numbers"),
            ("do = \"gravity\"\ngravity_m_s2 = [0, 1, 0]\nfriction = 1", "does not belong to `gravity`"),
            ("do = \"friction\"\nfriction = -1", "must be a number of at least 0, not -1"),
            ("do = \"wind\"\nwind_m_s = [0, 1e60, 0]", "must be a finite number"),
            ("do = \"wind\"\nspeed = 3", "unknown field"),
            ("do = \"fabric\"", "nothing of the fabric changes"),
            ("do = \"sew\"\na = \"x\"", "field `change.b`: is missing"),
            ("do = \"sew\"\na = {}\nb = \"x\"", "a side needs one of"),
            ("do = \"refine\"\ntimes = 9", "must be a whole number from 1 to 5"),
            ("do = \"welded\"", "is for records"),
            ("do = \"refine\"\nstep = 3", "acts at the next step"),
        ] {
            let fault = request(text).unwrap_err();
            assert!(fault.contains(sentence) && !fault.contains("line"), "{text}: {fault}");
        }
    }
}
