//! Names of preconditioners in scenes and on command lines. `solver` implements them.

use serde::{Deserialize, Serialize};

/// Preconditioner of PCG.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum PreconditionerKind {
    /// The fastest one that the executor has, by the number of rows.
    #[default]
    Auto,
    /// Inverses of the 3x3 diagonal blocks.
    Jacobi,
    /// Sweeps inside chunks of rows and a coarse level (`solver::Schwarz`).
    Schwarz,
}

impl PreconditionerKind {
    /// Names and choices.
    pub const CHOICES: [(&str, PreconditionerKind); 3] = [
        ("auto", PreconditionerKind::Auto),
        ("jacobi", PreconditionerKind::Jacobi),
        ("schwarz", PreconditionerKind::Schwarz),
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            PreconditionerKind::Auto => "auto",
            PreconditionerKind::Jacobi => "jacobi",
            PreconditionerKind::Schwarz => "schwarz",
        }
    }
}
