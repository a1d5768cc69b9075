//! The TOML scene format (`docs/scene.md`): text -> [`ParsedScene`].

use std::path::Path;

use toml::de::DeTable;

use super::change::{ROOT_FIELDS, changes};
use super::cloth_file::{CLOTH_FIELDS, FABRIC_FIELDS, Remarks, cloth, fabric, sheet_triangles, wrap};
use super::cloth_source::place_cloths;
use super::fields::{Fields, Source};
use super::model::RESOLUTIONS;
use super::obstacle_file::{OBSTACLE_FIELDS, is_from_file, obstacle};
use super::parsed::ParsedScene;
use super::pin_file::{PIN_FIELDS, Paths, pin};
use super::seam_file::{SEAM_FIELDS, seam, seams_of_cloth, sewing};
use super::settings_file::settings;
use super::time_table::time_table;
use super::{Fabric, SceneError, TimeTable};

/// Triangles of all sheets together if neither the scene nor the command line gives a resolution.
const DEFAULT_RESOLUTION: u64 = 10_000;

/// Reads `[time]` alone.
pub(super) fn read_time_table(text: &str, path: &Path) -> Result<TimeTable, SceneError> {
    let source = Source::new(path, text);
    let Ok(document) = DeTable::parse(text) else { return Ok(TimeTable::default()) };
    match Fields::root(&source, document.get_ref(), &ROOT_FIELDS) {
        Ok(root) => time_table(&root),
        Err(_) => Ok(TimeTable::default()),
    }
}

/// Reads a TOML scene. Relative file names start at the folder of `path`, and messages name `path`.
pub(super) fn parse(text: &str, path: &Path) -> Result<ParsedScene, SceneError> {
    let source = Source::new(path, text);
    let document = DeTable::parse(text).map_err(|error| {
        let line =
            error.span().map(|span| 1 + text.as_bytes().iter().take(span.start).filter(|&&c| c == b'\n').count());
        SceneError::Syntax { path: path.into(), line, what: error.message().replace('\n', ", ") }
    })?;
    let root = Fields::root(&source, document.get_ref(), &ROOT_FIELDS)?;
    time_table(&root)?;
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let name = root.or("name", stem, |value| value.text().map(str::to_owned))?;

    let fabrics = root.tables("fabric", &FABRIC_FIELDS)?.iter().map(fabric).collect::<Result<Vec<Fabric>, _>>()?;
    let tables = root.tables("cloth", &CLOTH_FIELDS)?;
    if tables.is_empty() {
        return Err(root.error_at("cloth", "a scene needs at least one `[[cloth]]`"));
    }
    let resolution = root.or("resolution", DEFAULT_RESOLUTION, |value| value.whole(RESOLUTIONS))?;
    let triangles = sheet_triangles(resolution, &tables, path)?;
    let (mut cloths, mut warnings, mut left_out) = (Vec::with_capacity(tables.len()), Vec::new(), Vec::new());
    for (i, table) in tables.iter().enumerate() {
        cloths.push(cloth(
            table,
            i,
            triangles[i],
            &fabrics,
            path,
            &mut Remarks { warnings: &mut warnings, left_out: &mut left_out },
        )?);
    }
    let (mut cloths, origin_m) = place_cloths(cloths)?;
    let settings = settings(&root, origin_m, &mut warnings)?;
    let mut obstacles = Vec::new();
    let mut from_file = Vec::new();
    for (i, fields) in root.tables("obstacle", &OBSTACLE_FIELDS)?.iter().enumerate() {
        from_file.push(is_from_file(fields));
        let mut remarks = Remarks { warnings: &mut warnings, left_out: &mut left_out };
        obstacles.push(obstacle(fields, i, settings.friction, path, origin_m, &mut remarks)?);
    }
    for (cloth, fields) in cloths.iter_mut().zip(&tables) {
        cloth.wrap = wrap(fields, &obstacles)?;
    }
    let (mut pins, mut paths) = (Vec::new(), Paths::default());
    for fields in root.tables("pin", &PIN_FIELDS)? {
        pins.push(pin(&fields, &cloths, &obstacles, origin_m, &mut paths)?);
    }
    let mut seams = Vec::new();
    for (i, table) in tables.iter().enumerate() {
        seams.extend(seams_of_cloth(table, i, &cloths[i])?);
    }
    for (i, fields) in root.tables("seam", &SEAM_FIELDS)?.iter().enumerate() {
        seams.push(seam(fields, i, &cloths)?);
    }
    let sewing = sewing(&root, !seams.is_empty())?;
    let seams_at = match root.get("seam") {
        Some(_) => root.place_at("seam"),
        None => root.place_at("cloth"),
    };
    let changes = changes(&root, text)?;
    let scene = ParsedScene {
        path: path.into(),
        name,
        origin_m,
        cloths,
        fabrics,
        pins,
        changes,
        seams,
        sewing,
        motions: paths.motions,
        followed: paths.followed,
        obstacles,
        settings,
        warnings,
        left_out,
        cloths_at: root.place_at("cloth"),
        pins_at: root.place_at("pin"),
        seams_at,
    };
    Ok(scene.warn_of_sizes(|obstacle| from_file[obstacle]))
}
