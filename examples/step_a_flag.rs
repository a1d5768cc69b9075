//! Steps a flag on 1 and on 4 ranks (threads of this process) and compares the bits of the two states.
//!
//! `cargo run --release --example step_a_flag -- [SCENE] [STEPS]`

use std::error::Error;
use std::path::Path;

use loomtree::{Launch, RunOptions, RunPlan, Session, SessionPlace};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let scene = arguments.next().unwrap_or_else(|| "scenes/flag.toml".into());
    let steps = arguments.next().map_or(Ok(25), |text| text.parse())?;
    let hash_on = |workers| -> Result<String, Box<dyn Error>> {
        let options = RunOptions { workers, resolution: Some(2000), ..RunOptions::default() };
        let plan = RunPlan::new(Path::new(&scene), &options)?;
        let mut session = Session::assemble(SessionPlace::ALONE, &options.session(), &Launch::Threads)?;
        session.load(&plan)?;
        session.advance(steps, &mut ())?;
        Ok(session.state()?.hash())
    };
    let (one, four) = (hash_on(1)?, hash_on(4)?);
    println!("{scene} after {steps} steps: {one} on 1 rank, {four} on 4 ranks");
    if one == four { Ok(()) } else { Err("the states differ".into()) }
}
