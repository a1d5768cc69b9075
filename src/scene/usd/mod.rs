//! Bodies from USD stages (`.usda`, `.usdc`, `.usd`, `.usdz`): meshes whose points have samples, below transforms that
//! may move, and meshes that hang on a UsdSkel skeleton. The crate `openusd` reads and composes the layers; what the
//! attributes mean is here.

mod guard;
mod mesh;
mod resolver;
mod skeleton;
mod transform;
mod value;

use std::io::Read as _;
use std::path::Path;

use openusd::sdf::{self, Value};
use openusd::usd::{Prim, PrimPredicate, Stage};

use super::SceneError;
use super::sampled::{SampledBody, is_below, sampled};
use crate::math::DQuat;
use crate::os::panics::caught;
use resolver::GuardedResolver;
use value::{broken, one_line};

pub(super) use skeleton::SkinnedBody;

/// Meters per unit of a stage that does not say it, by the standard.
const UNIT_M: f64 = 0.01;

/// What a stage has in it.
pub(super) struct UsdBody {
    /// Meters per unit.
    pub unit_m: f64,
    /// False: the stage does not say its unit.
    pub says_unit: bool,
    /// The rotation that brings its up axis to y.
    pub up: DQuat,
    pub kind: UsdKind,
}

/// How the vertices move, in the coordinates of the stage.
pub(super) enum UsdKind {
    Sampled(SampledBody),
    Skinned(SkinnedBody),
}

/// Reads the meshes of a stage; `only` = those of the prim with this name or path, and of those below it. At most
/// `most` positions are held.
pub(super) fn read_usd(path: &Path, only: Option<&str>, most: usize) -> Result<UsdBody, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let name = path.to_str().ok_or_else(|| fault("has a name that is not UTF-8".into()))?;
    let file = std::fs::metadata(path).map_err(|error| fault(format!("cannot be read: {error}")))?;
    if !file.is_file() {
        return Err(fault("cannot be read: it is not a file".into()));
    }
    guard(path).map_err(fault)?;
    // The crate relies on files whose parts agree; where they do not, it panics.
    match caught(|| body(name, only, most)) {
        Some(body) => body.map_err(fault),
        None => Err(fault("is damaged: its parts contradict each other".into())),
    }
}

/// Checks a binary stage or a package, and nothing of another file.
fn guard(path: &Path) -> Result<(), String> {
    const HEAD: u64 = 16;
    let unreadable = |error: std::io::Error| format!("cannot be read: {error}");
    let mut head = Vec::new();
    let mut file = std::fs::File::open(path).map_err(unreadable)?;
    file.by_ref().take(HEAD).read_to_end(&mut head).map_err(unreadable)?;
    match guard::is_checked(&head) {
        true => guard::check(&std::fs::read(path).map_err(unreadable)?),
        false => Ok(()),
    }
}

fn body(name: &str, only: Option<&str>, most: usize) -> Result<UsdBody, String> {
    let stage = Stage::builder()
        .resolver(GuardedResolver::new())
        .open(name)
        .map_err(|error| format!("is not a USD stage: {}", one_line(&error)))?;
    let body = read(&stage, only, most);
    // Without a layer there may be no mesh, which then is not what is wrong.
    match stage.composition_errors().first() {
        Some(error) => Err(format!("refers to what cannot be read: {}", one_line(error))),
        None => body,
    }
}

fn read(stage: &Stage, only: Option<&str>, most: usize) -> Result<UsdBody, String> {
    let number =
        |key: &str| stage.stage_metadata(key).map_err(broken).map(|value| value.and_then(|v| value::number(&v)));
    let unit_m = number("metersPerUnit")?;
    let up = match stage.stage_metadata("upAxis").map_err(broken)? {
        Some(Value::Token(axis)) if axis.as_str() == "Z" => DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2),
        _ => DQuat::IDENTITY,
    };
    let per_s = stage.time_codes_per_second();
    if !(per_s > 0.0 && per_s.is_finite()) || unit_m.is_some_and(|unit| !(unit > 0.0 && unit.is_finite())) {
        return Err(format!("has {per_s} time codes per second and {unit_m:?} meters per unit; both must be above 0"));
    }
    let mut paths: Vec<sdf::Path> = Vec::new();
    stage.traverse(PrimPredicate::DEFAULT_PROXIES, |path| paths.push(path.clone())).map_err(broken)?;
    let (mut meshes, mut all, mut hidden) = (Vec::new(), Vec::new(), 0);
    for path in paths {
        let prim = stage.prim(path.clone());
        if prim.type_name().map_err(broken)?.is_none_or(|name| name.as_str() != "Mesh") {
            continue;
        }
        all.push(path.as_str().to_owned());
        match only {
            Some(name) if !is_below(path.as_str(), name) => {}
            None if is_hidden(&prim)? => hidden += 1,
            _ => meshes.push(prim),
        }
    }
    if meshes.is_empty() {
        return Err(match only {
            Some(name) if !all.is_empty() => format!("has no mesh in `{name}`; its meshes are {}", all.join(", ")),
            _ if hidden > 0 => "has no mesh that is visible and meant to be drawn; `node` names one".into(),
            _ => "has no mesh in it".into(),
        });
    }
    let is_skinned = meshes.iter().map(skeleton::is_skinned).collect::<Result<Vec<bool>, String>>()?;
    let kind = if is_skinned.contains(&true) {
        UsdKind::Skinned(skeleton::skinned(stage, &meshes, per_s)?)
    } else {
        let meshes = meshes.iter().map(|prim| mesh::mesh(prim, per_s)).collect::<Result<Vec<_>, String>>()?;
        UsdKind::Sampled(sampled(meshes, most)?)
    };
    Ok(UsdBody { unit_m: unit_m.unwrap_or(UNIT_M), says_unit: unit_m.is_some(), up, kind })
}

/// True for a mesh that is invisible, a guide or a stand-in, by itself or by a prim above.
fn is_hidden(prim: &Prim) -> Result<bool, String> {
    for path in prim.path().ancestors_below_root() {
        let prim = prim.stage().prim(path);
        for (name, words) in [("visibility", ["invisible", ""]), ("purpose", ["guide", "proxy"])] {
            match prim.attribute(name).get::<Value>().map_err(broken)? {
                Some(Value::Token(word)) if words.contains(&word.as_str()) => return Ok(true),
                _ => {}
            }
        }
    }
    Ok(false)
}
