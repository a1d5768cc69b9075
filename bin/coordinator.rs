//! The coordinator alone: prints the run's identifier, waits for `loomtree-worker` processes, runs the scene.
//! Becomes `loomtree coordinator`, so that a program of its own costs a few hundred kilobytes.

mod sibling;

fn main() -> std::process::ExitCode {
    sibling::become_command("coordinator")
}
