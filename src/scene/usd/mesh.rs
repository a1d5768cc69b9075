//! A USD mesh: faces that stay, points that may have samples.

use openusd::sdf::Value;
use openusd::usd::Prim;

use super::transform::Placing;
use super::value::{self, broken};
use crate::math::Vec3;
use crate::mesh::triangles_of_faces;
use crate::scene::sampled::{SampledMesh, around, placed};

/// Samples of points.
pub(super) struct Points {
    /// Time codes, ascending; empty if the points have one value for all times.
    pub codes: Vec<f64>,
    /// The points at these time codes, or the one value.
    pub frames: Vec<Vec<Vec3>>,
    /// The value that does not depend on time, if there is one.
    pub still: Option<Vec<Vec3>>,
}

/// Reads the points of a mesh. An error is half a sentence.
pub(super) fn points(prim: &Prim) -> Result<Points, String> {
    let attribute = prim.attribute("points");
    let path = prim.path();
    let none = || format!("has a mesh without points: `{path}`");
    let still = value::value(&attribute, None)?.map(|found| value::vectors(found).ok_or_else(none)).transpose()?;
    let codes = attribute.time_sample_times().map_err(broken)?;
    let mut frames = Vec::with_capacity(codes.len());
    for &code in &codes {
        let frame = value::value(&attribute, Some(code))?.and_then(value::vectors).ok_or_else(none)?;
        let count = frames.first().map_or(frame.len(), Vec::len);
        if frame.len() != count {
            let now = frame.len();
            return Err(format!(
                "has a mesh whose points change in number: `{path}` has {count}, and {now} at time code {code}"
            ));
        }
        if let Some(point) = frame.iter().position(|p| !p.is_finite()) {
            return Err(format!("point {point} (from 0) of `{path}` at time code {code} is not a finite number"));
        }
        frames.push(frame);
    }
    if frames.is_empty() {
        frames.push(still.clone().ok_or_else(none)?);
    }
    let still = still.filter(|still| still.len() == frames[0].len());
    Ok(Points { codes, frames, still })
}

/// The triangles of a mesh, counter-clockwise seen from outside.
pub(super) fn triangles(prim: &Prim, points: &[Vec3]) -> Result<Vec<[u32; 3]>, String> {
    let path = prim.path();
    let list = |name: &str| -> Result<Vec<usize>, String> {
        let attribute = prim.attribute(name);
        let codes = attribute.time_sample_times().map_err(broken)?;
        let read = |code: Option<f64>| -> Result<Vec<i32>, String> {
            let found = value::value(&attribute, code)?.and_then(value::integers);
            found.ok_or_else(|| format!("has a mesh without {name}: `{path}`"))
        };
        let first = read(codes.first().copied())?;
        for &code in codes.iter().skip(1) {
            if read(Some(code))? != first {
                return Err(format!("has a mesh whose faces change at time code {code}: `{path}`"));
            }
        }
        let whole = first.iter().map(|&x| usize::try_from(x)).collect::<Result<Vec<usize>, _>>();
        whole.map_err(|_| format!("has a negative number in {name} of `{path}`"))
    };
    let counts = list("faceVertexCounts")?;
    let mut corners: Vec<u32> = list("faceVertexIndices")?.into_iter().map(|v| v as u32).collect();
    if let Some(Value::Token(word)) = value::value(&prim.attribute("orientation"), None)?
        && word.as_str() == "leftHanded"
    {
        let mut rest = &mut corners[..];
        for &count in &counts {
            let Some((face, others)) = rest.split_at_mut_checked(count) else { break };
            face.reverse();
            rest = others;
        }
    }
    triangles_of_faces(&counts, corners, points).map_err(|what| format!("`{path}`: {what}"))
}

/// A mesh whose points and transform have samples.
pub(super) fn mesh<'a>(prim: &'a Prim, per_s: f64) -> Result<SampledMesh<'a>, String> {
    let Points { codes, frames, still } = points(prim)?;
    let mut triangles = triangles(prim, &frames[0])?;
    let placing = Placing::of(prim)?;
    let turns = !placing.codes.is_empty();
    let mut all: Vec<f64> = if frames.len() > 1 { codes.clone() } else { Vec::new() };
    all.extend(&placing.codes);
    all.sort_by(f64::total_cmp);
    let start = placing.at(all.first().copied().unwrap_or(0.0))?;
    if start.matrix3.determinant() < 0.0 {
        triangles.iter_mut().for_each(|corners| corners.swap(1, 2));
    }
    let rest = still.map(|still| placed(&still, &still, 0.0, &start));
    let times_s: Vec<f64> = codes.iter().map(|code| code / per_s).collect();
    let at = move |time_s: f64| {
        let (before, after, share) = if frames.len() > 1 { around(&times_s, time_s) } else { (0, 0, 0.0) };
        Ok(placed(&frames[before], &frames[after], share, &placing.at(time_s * per_s)?))
    };
    Ok(SampledMesh {
        name: prim.path().as_str().to_owned(),
        triangles,
        times_s: all.iter().map(|code| code / per_s).collect(),
        turns,
        rest,
        at: Box::new(at),
    })
}
