//! A person made by formulas, for scenes without a file of a body: a surface around round cones, a skeleton, skin
//! weights, clips and clothes that start around the rest pose. What it gives is a [`BodyFile`](super::BodyFile) as
//! glTF files are, so that everything from the clip on is one code.

mod anatomy;
mod body;
mod clips;
mod cone;
mod garment;

pub(super) use body::person;
pub(super) use garment::{Garment, KINDS};
