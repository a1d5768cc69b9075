//! Number of sub-steps in scenes and on command lines. `step` makes them.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Sub-steps that a step is made in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Substeps {
    /// As many as the motion asks for, from the state alone.
    #[default]
    Auto,
    /// This number of equal ones, from 1 to [`Substeps::MOST`].
    Fixed(u32),
}

impl Substeps {
    /// Largest number of sub-steps.
    pub const MOST: u32 = 1000;
}

impl FromStr for Substeps {
    type Err = String;
    fn from_str(text: &str) -> Result<Substeps, String> {
        let number = text.parse().ok().filter(|number| (1..=Substeps::MOST).contains(number));
        match (text, number) {
            ("auto", _) => Ok(Substeps::Auto),
            (_, Some(number)) => Ok(Substeps::Fixed(number)),
            _ => Err(format!("{text:?} is neither auto nor a whole number from 1 to {}", Substeps::MOST)),
        }
    }
}

impl TryFrom<String> for Substeps {
    type Error = String;
    fn try_from(text: String) -> Result<Substeps, String> {
        text.parse()
    }
}

impl From<Substeps> for String {
    fn from(substeps: Substeps) -> String {
        match substeps {
            Substeps::Auto => "auto".into(),
            Substeps::Fixed(number) => number.to_string(),
        }
    }
}
