//! One worker process: `loomtree-worker --run ID --rank R`. Becomes `loomtree worker`, so that a program of its own
//! costs a few hundred kilobytes.

mod sibling;

fn main() -> std::process::ExitCode {
    sibling::become_command("worker")
}
