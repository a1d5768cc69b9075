//! `loomtree live`: asks a run that goes on to change something, from the shell.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use serde_json::{Map, Value, json};

use super::{CliError, print};
use crate::coordinator::live::{LiveError, connect};
use crate::output::{RunDirectory, Status};

/// Time that a run gets to begin, and pause between two looks.
const STARTING: Duration = Duration::from_secs(5);
const LOOK: Duration = Duration::from_millis(50);

/// Steer a run that was started with --live: pause, step, wind, gravity, friction, fabrics, pins, seams
///
/// Prints the answer as one line of JSON: the number of steps after which a change acts. Every change is recorded in
/// the run directory (run_changes.toml), so that --resume and --replay make it again with the same bits.
#[derive(Args, Clone, Debug)]
pub struct LiveArgs {
    /// Run directory
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// What to do
    #[command(subcommand)]
    pub command: LiveCommand,
}

/// What a run is asked to do.
#[derive(Subcommand, Clone, Debug)]
pub enum LiveCommand {
    /// Stand still after the step under way
    Pause,
    /// Go on
    #[command(alias = "resume")]
    Continue,
    /// Make N steps, then stand still; answers when they are made
    Step {
        /// Number of steps
        #[arg(value_name = "N", default_value_t = 1)]
        steps: u32,
    },
    /// Say where the run is and what can be changed
    Status,
    /// Set the wind, such as 3,0,0 (m/s)
    Wind {
        /// Velocity of the air, m/s
        #[arg(value_name = "X,Y,Z", allow_hyphen_values = true, value_parser = vector)]
        wind_m_s: Vector,
        /// Density of the air, kg/m^3 [default: as it is; 1.2 in a scene without air]
        #[arg(long, value_name = "KG_M3")]
        density: Option<f64>,
        /// Drag of the air along the cloth, kg/(m^2 s) [default: as it is]
        #[arg(long, value_name = "KG_M2_S")]
        drag: Option<f64>,
    },
    /// Set gravity, such as 0,-1.6,0 (m/s^2); panels that are sewn get weight by it
    Gravity {
        /// Acceleration, m/s^2
        #[arg(value_name = "X,Y,Z", allow_hyphen_values = true, value_parser = vector)]
        gravity_m_s2: Vector,
    },
    /// Set the friction of a cloth, an obstacle or everything
    Friction {
        /// Coulomb friction coefficient
        friction: f64,
        /// Of this cloth alone (name or number)
        #[arg(long, value_name = "NAME", conflicts_with = "obstacle")]
        cloth: Option<String>,
        /// Of this obstacle alone
        #[arg(long, value_name = "NAME")]
        obstacle: Option<String>,
    },
    /// Change the fabric of a cloth, of all cloths of a fabric, or of everything
    Fabric {
        /// Another fabric: a preset, one of the scene, or a .json file beside it
        #[arg(value_name = "FABRIC")]
        fabric: Option<String>,
        /// Of this cloth alone (name or number)
        #[arg(long, value_name = "NAME", conflicts_with = "of")]
        cloth: Option<String>,
        /// Of the cloths that have this fabric now
        #[arg(long, value_name = "FABRIC")]
        of: Option<String>,
        /// Density, kg/m^2
        #[arg(long, value_name = "KG_M2")]
        density: Option<f64>,
        /// Stretching stiffness, N/m: warp,cross,weft,shear
        #[arg(long, value_name = "LIST", value_delimiter = ',', num_args = 1)]
        stretching: Option<Vec<f64>>,
        /// Bending stiffness, N m
        #[arg(long, value_name = "N_M")]
        bending: Option<f64>,
        /// Damping, seconds
        #[arg(long, value_name = "S")]
        damping: Option<f64>,
    },
    /// Let a pin go
    Pin {
        /// Name of the pin, or its number in the scene, from 0
        pin: String,
        /// off: its vertices are free from now on
        #[arg(value_parser = ["off"])]
        off: String,
    },
    /// Sew a seam, or take one out that is not closed yet
    #[command(subcommand)]
    Seam(SeamCommand),
    /// Divide every triangle into four
    Refine {
        /// How often
        #[arg(value_name = "N", default_value_t = 1)]
        times: u32,
    },
    /// Write the scene with all changes so far as a file that makes the same run
    Save {
        /// The scene file to write (.toml)
        #[arg(value_name = "FILE")]
        file: PathBuf,
    },
    /// End the run as Ctrl-C does; it can be resumed
    Stop,
    /// Send lines of JSON from stdin as they are, and print the answers
    Json,
}

/// What happens to a seam.
#[derive(Subcommand, Clone, Debug)]
pub enum SeamCommand {
    /// Sew two sides: EDGE, CLOTH:EDGE, CLOTH:V1,V2 (vertices of its file) or @V1,V2 (vertices of the frames)
    Add {
        /// The first side
        #[arg(value_name = "SIDE")]
        a: String,
        /// The second side; its first vertex meets the first one of the other
        #[arg(value_name = "SIDE")]
        b: String,
        /// Name of the seam
        #[arg(long)]
        name: Option<String>,
        /// Seconds until the seams are closed [default: as the scene has it, or 0.6]
        #[arg(long, value_name = "S")]
        close_s: Option<f64>,
        /// Gap at which seams count as closed, meters [default: as the scene has it, or 0.001]
        #[arg(long, value_name = "M")]
        weld_m: Option<f64>,
        /// Angle that its edges have at rest, degrees; positive stands out on the outside [default: 0]
        #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
        angle_deg: Option<f64>,
    },
    /// Take a seam out
    Remove {
        /// Its name
        name: String,
    },
}

/// Three numbers.
type Vector = [f64; 3];

fn vector(text: &str) -> Result<Vector, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse::<f64>()).collect();
    let numbers = numbers.ok().and_then(|numbers| Vector::try_from(numbers).ok());
    numbers
        .filter(|vector| vector.iter().all(|x| x.is_finite()))
        .ok_or_else(|| "expected X,Y,Z, such as 3,0,0.5".into())
}

/// A side of a seam as a request has it.
fn side(text: &str) -> Result<Value, CliError> {
    let list = |text: &str| text.split(',').map(|v| v.trim().parse::<u32>().ok()).collect::<Option<Vec<u32>>>();
    if let Some(vertices) = text.strip_prefix('@') {
        let what = || CliError::bad_input(format!("`{text}`: expected vertices behind the @, such as @12,40"));
        return Ok(json!({ "frame_vertices": list(vertices).ok_or_else(what)? }));
    }
    Ok(match text.rsplit_once(':') {
        None => json!(text),
        Some((cloth, rest)) => match list(rest) {
            Some(vertices) => json!({ "cloth": cloth, "vertices": vertices }),
            None => json!({ "cloth": cloth, "edge": rest }),
        },
    })
}

/// A request of its kind with the fields that are there.
fn request(what: &str, fields: Value) -> Value {
    let mut request = Map::new();
    request.insert("do".into(), what.into());
    if let Value::Object(fields) = fields {
        request.extend(fields.into_iter().filter(|(_, value)| !value.is_null()));
    }
    Value::Object(request)
}

/// The request of a command; none for `json`.
fn request_of(command: &LiveCommand) -> Result<Option<Value>, CliError> {
    Ok(Some(match command {
        LiveCommand::Pause => request("pause", Value::Null),
        LiveCommand::Continue => request("continue", Value::Null),
        LiveCommand::Step { steps } => request("step", json!({ "steps": steps })),
        LiveCommand::Status => request("status", Value::Null),
        LiveCommand::Wind { wind_m_s, density, drag } => {
            let fields = json!({ "wind_m_s": wind_m_s, "air_density_kg_m3": density, "air_drag_kg_m2_s": drag });
            request("wind", fields)
        }
        LiveCommand::Gravity { gravity_m_s2 } => request("gravity", json!({ "gravity_m_s2": gravity_m_s2 })),
        LiveCommand::Friction { friction, cloth, obstacle } => {
            request("friction", json!({ "friction": friction, "cloth": cloth, "obstacle": obstacle }))
        }
        LiveCommand::Fabric { fabric, cloth, of, density, stretching, bending, damping } => request(
            "fabric",
            json!({
                "fabric": fabric,
                "cloth": cloth,
                "of_fabric": of,
                "density_kg_m2": density,
                "stretching_n_m": stretching,
                "bending_n_m": bending,
                "damping_s": damping,
            }),
        ),
        LiveCommand::Pin { pin, .. } => request("unpin", json!({ "pin": pin })),
        LiveCommand::Seam(SeamCommand::Add { a, b, name, close_s, weld_m, angle_deg }) => {
            let (a, b) = (side(a)?, side(b)?);
            let fields = json!({
                "name": name,
                "a": a,
                "b": b,
                "close_s": close_s,
                "weld_m": weld_m,
                "angle_deg": angle_deg,
            });
            request("sew", fields)
        }
        LiveCommand::Seam(SeamCommand::Remove { name }) => request("unsew", json!({ "name": name })),
        LiveCommand::Refine { times } => request("refine", json!({ "times": times })),
        LiveCommand::Save { file } => {
            // The run has another working directory.
            let path = std::path::absolute(file).map_err(CliError::bad_input)?;
            request("save", json!({ "file": path.to_string_lossy() }))
        }
        LiveCommand::Stop => request("stop", Value::Null),
        LiveCommand::Json => return Ok(None),
    }))
}

/// Connects to the run in a directory. One that was started a moment ago is waited for: it reads its scene before it
/// listens, and scripts start it in the background.
fn connect_soon(run: &Path) -> Result<UnixStream, LiveError> {
    let begun = Instant::now();
    loop {
        match connect(run) {
            Err(_) if begun.elapsed() < STARTING && !has_ended(run) => std::thread::sleep(LOOK),
            connected => return connected,
        }
    }
}

/// Whether the report in a run directory says that its run has ended.
fn has_ended(run: &Path) -> bool {
    #[derive(serde::Deserialize)]
    struct Ended {
        status: Status,
    }
    let report = RunDirectory::open(run).ok().and_then(|directory| std::fs::read(directory.report()).ok());
    let ended: Option<Ended> = report.and_then(|report| serde_json::from_slice(&report).ok());
    ended.is_some_and(|ended| ended.status != Status::Running)
}

/// Runs the command.
///
/// # Errors
/// Nobody listens in the run directory, or the run refuses: exit code 2 with its sentence.
pub fn run(args: LiveArgs) -> Result<(), CliError> {
    let request = request_of(&args.command)?;
    let mut stream = connect_soon(&args.run).map_err(CliError::bad_input)?;
    let lost = |error: std::io::Error| CliError::failed(format!("the connection to the run was lost: {error}"));
    let mut answers = BufReader::new(stream.try_clone().map_err(lost)?);
    let mut ask = |line: &str| -> Result<String, CliError> {
        stream.write_all(format!("{line}\n").as_bytes()).map_err(lost)?;
        let mut answer = String::new();
        match answers.read_line(&mut answer).map_err(lost)? {
            0 => Err(CliError::failed("the run has ended before it answered")),
            _ => Ok(answer),
        }
    };
    match request {
        Some(request) => {
            let answer = ask(&request.to_string())?;
            let value: Value = serde_json::from_str(&answer).unwrap_or_default();
            match value.get("error").and_then(Value::as_str) {
                Some(why) => Err(CliError::bad_input(why)),
                None => print(&answer),
            }
        }
        None => {
            for line in std::io::stdin().lock().lines() {
                let line = line.map_err(|error| CliError::failed(format!("cannot read stdin: {error}")))?;
                if !line.trim().is_empty() {
                    print(&ask(&line)?)?;
                }
            }
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vectors_and_sides_are_read() {
        assert_eq!(vector("3, -1.5,0"), Ok([3.0, -1.5, 0.0]));
        for text in ["3,0", "3,0,0,0", "a,b,c", "", "inf,0,0"] {
            assert!(vector(text).is_err(), "{text}");
        }
        assert_eq!(side("left"), Ok(json!("left")));
        assert_eq!(side("front:top"), Ok(json!({ "cloth": "front", "edge": "top" })));
        assert_eq!(side("front:3,4"), Ok(json!({ "cloth": "front", "vertices": [3, 4] })));
        assert_eq!(side("@3,4"), Ok(json!({ "frame_vertices": [3, 4] })));
        assert!(side("@3,x").is_err());
    }

    #[test]
    fn absent_fields_are_not_sent() {
        let fabric = LiveCommand::Friction { friction: 0.5, cloth: None, obstacle: Some("ball".into()) };
        let expected = json!({ "do": "friction", "friction": 0.5, "obstacle": "ball" });
        assert_eq!(request_of(&fabric).unwrap(), Some(expected));
    }
}
