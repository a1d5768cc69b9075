//! Errors of the setup and of the steps of a rank. A [`Failure`] is created on the rank and travels to the coordinator
//! unchanged; [`Failure::sentence`] is the only place that puts it into words.

use std::borrow::Cow;
use std::fmt;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::linear_system::SolveError;
use crate::transport::TransportError;

/// Error of the setup of a rank.
#[derive(Debug, Error)]
pub enum SetupError {
    /// A vertex has too many neighbors.
    #[error(transparent)]
    RowTooLong(#[from] crate::assembly::RowTooLong),
    /// The requested preconditioner is not available on this executor.
    #[error("{0}")]
    Preconditioner(String),
    /// Products without a stored matrix were requested on another executor or in another exchange mode.
    #[error("products without a stored matrix need the cpu executor and --exchange halo")]
    MatrixFree,
    /// The data for collisions is inconsistent.
    #[error("collisions: {0}")]
    Collision(String),
    /// The data of pins is inconsistent.
    #[error("pins: {0}")]
    Pins(String),
    /// The device refused.
    #[error(transparent)]
    Device(#[from] crate::gpu::GpuError),
}

/// An object that the scene moves, so that cloth cannot push it away.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Imposed {
    /// An obstacle, by its name.
    Obstacle(String),
    /// A pinned vertex, by its global row.
    Pin(u32),
}

/// Error that ends the steps of a rank. Rows are global.
#[allow(missing_docs, reason = "the line of a variant says what it carries")]
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Failure {
    /// A transfer failed: another rank ended, is silent, or the run was told to stop. The cause lies elsewhere.
    Transport(String),
    /// Bad input that only a rank can detect.
    BadInput(String),
    /// A value that is not finite. `suspect` names the fields of the scene that usually cause it.
    NotFinite { step: u32, row: u32, quantity: Cow<'static, str>, cause: String, suspect: Cow<'static, str> },
    /// No state without penetration was found at the end of the step.
    Squeezed { step: u32, imposed: Vec<Imposed> },
    /// A step failed for another reason: collision detection, the solve or the device.
    Step { step: u32, cause: String },
    /// Anything else.
    Other(String),
}

/// Maximum number of culprits of each kind that [`Failure::Squeezed`] names.
const NAMED_MOST: usize = 3;

impl Failure {
    /// A failure of step `step`.
    pub fn in_step(step: u32, cause: impl fmt::Display) -> Failure {
        Failure::Step { step, cause: cause.to_string() }
    }

    /// The sentence for the user. `vertex_name` names the vertex of a global row.
    pub fn sentence(&self, vertex_name: &dyn Fn(u32) -> String) -> String {
        match self {
            Failure::Transport(text) | Failure::BadInput(text) | Failure::Other(text) => text.clone(),
            Failure::NotFinite { step, row, quantity, cause, suspect } => {
                let vertex = vertex_name(*row);
                format!("step {step}: the {quantity} of {vertex} is not finite ({cause}); likely too large: {suspect}")
            }
            Failure::Squeezed { step, imposed } => squeezed(*step, imposed, vertex_name),
            Failure::Step { step, cause } => format!("step {step}: {cause}"),
        }
    }
}

/// [`Failure::sentence`] with rows instead of vertices.
impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.sentence(&|row| format!("row {row}")))
    }
}

impl std::error::Error for Failure {}

impl From<TransportError> for Failure {
    fn from(error: TransportError) -> Failure {
        Failure::Transport(error.to_string())
    }
}

impl From<SetupError> for Failure {
    fn from(error: SetupError) -> Failure {
        match error {
            SetupError::Preconditioner(text) => Failure::BadInput(text),
            other => Failure::Other(other.to_string()),
        }
    }
}

impl From<SolveError> for Failure {
    fn from(error: SolveError) -> Failure {
        match error {
            SolveError::Transport(error) => error.into(),
            SolveError::Preconditioner(text) => Failure::BadInput(text),
        }
    }
}

fn squeezed(step: u32, imposed: &[Imposed], vertex_name: &dyn Fn(u32) -> String) -> String {
    let mut obstacles: Vec<&str> = Vec::new();
    let mut pins: Vec<String> = Vec::new();
    for one in imposed {
        match one {
            Imposed::Obstacle(name) => obstacles.push(name),
            Imposed::Pin(row) => pins.push(vertex_name(*row)),
        }
    }
    let mut culprits: Vec<String> =
        obstacles.iter().take(NAMED_MOST).map(|name| format!("the obstacle `{name}`")).collect();
    culprits.extend(pins.iter().take(NAMED_MOST).map(|vertex| format!("the pin of {vertex}")));
    let unnamed = obstacles.len().saturating_sub(NAMED_MOST) + pins.len().saturating_sub(NAMED_MOST);
    if unnamed > 0 {
        culprits.push(format!("{unnamed} more"));
    }
    let who = if culprits.is_empty() { "what moves in the scene".to_string() } else { culprits.join(", ") };
    format!(
        "step {step}: the cloth cannot be kept free of penetration, {who} left it no room; move them less or more slowly, or shorten simulation.step_s"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sentences_name_step_vertex_and_culprits() {
        let name = |row: u32| format!("vertex {} of `sheet`", row + 100);
        let (quantity, suspect) = ("velocity".into(), "air.wind".into());
        let failure = Failure::NotFinite { step: 7, row: 3, quantity, cause: "p'Ap = NaN".into(), suspect };
        let expected =
            "step 7: the velocity of vertex 103 of `sheet` is not finite (p'Ap = NaN); likely too large: air.wind";
        assert_eq!(failure.sentence(&name), expected);
        assert!(failure.to_string().contains("the velocity of row 3 is"), "{failure}");
        let pins = (0..5).map(Imposed::Pin);
        let imposed = std::iter::once(Imposed::Obstacle("ball".into())).chain(pins).collect();
        let text = Failure::Squeezed { step: 2, imposed }.sentence(&name);
        let culprits = "the obstacle `ball`, the pin of vertex 100 of `sheet`, the pin of vertex 101 of `sheet`, \
                        the pin of vertex 102 of `sheet`, 2 more left it no room";
        assert!(text.starts_with("step 2: ") && text.contains(culprits), "{text}");
        let nobody = Failure::Squeezed { step: 2, imposed: Vec::new() }.to_string();
        assert!(nobody.contains("what moves in the scene left it no room"), "{nobody}");
        assert_eq!(Failure::in_step(4, "the device is gone").to_string(), "step 4: the device is gone");
    }
}
