//! Prescribed vertices of a rank: the vertices held at a time, and their targets. Host only, because a cloth has few of
//! them.
//!
//! A pin moves by the *change* of its motion since it took hold, so a pin that takes hold later does not jump. Targets
//! depend on the scene and the state at t0 only, never on earlier steps, so a resumed run gives the same bits.

use crate::math::{DVec3, Vec3};
use crate::scene::{Grip, Motion, Obstacles};

/// A pin on an own row.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RankPin {
    /// Own row.
    pub row: u32,
    /// Start position of the vertex, meters.
    pub start_m: [f32; 3],
    /// Motion of a moving pin; not used with a grip.
    pub motion: Option<u32>,
    /// Place on a triangle of the followed obstacles, which the vertex keeps.
    pub grip: Option<Grip>,
    /// Start of the hold, seconds.
    pub start_s: f64,
    /// End of the hold, seconds.
    pub end_s: f64,
}

/// What the pins of a rank move with.
#[derive(Clone, Debug, Default)]
pub struct PinPaths {
    /// Motions of the scene.
    pub motions: Vec<Motion>,
    /// Vertices of obstacles that grips name.
    pub followed: Obstacles,
}

impl PinPaths {
    /// The followed vertices at a time, xyz.
    fn at(&self, time_s: f64) -> Vec<f32> {
        let mut values = Vec::new();
        self.followed.positions_at(time_s, &mut values);
        values
    }
}

/// State of a held row at t0.
#[derive(Clone, Copy, Debug)]
struct Held {
    position: Vec3,
    velocity: Vec3,
}

/// All pins of a rank.
#[derive(Clone, Debug)]
pub struct Pins {
    pins: Vec<RankPin>,
    held: Vec<Option<Held>>,
}

/// Rows to prescribe in a step, with their targets.
#[derive(Debug, Default, PartialEq)]
pub struct PinTargets {
    /// Own rows, in the order of the pins.
    pub rows: Vec<u32>,
    /// Positions at t1, meters.
    pub positions: Vec<[f32; 3]>,
    /// Velocities at t1, m/s.
    pub velocities: Vec<[f32; 3]>,
    /// Velocity changes over the step, m/s.
    pub velocity_changes: Vec<[f32; 3]>,
}

impl Pins {
    /// Pins of a rank, none of them held yet.
    pub fn new(pins: Vec<RankPin>) -> Pins {
        Pins { held: vec![None; pins.len()], pins }
    }

    /// True if the set of held rows changes in the step that starts at `time_s`, which it always does in the first step
    /// from a state that was set.
    pub fn changes(&self, time_s: f64, step_s: f64) -> bool {
        self.pins
            .iter()
            .zip(&self.held)
            .any(|(pin, held)| is_held((pin.start_s, pin.end_s), time_s, step_s) != held.is_some())
    }

    /// Releases all pins, because another state has been set. The next step takes hold of the pins that are due.
    pub fn release_all(&mut self) {
        self.held.fill(None);
    }

    /// Takes hold of and releases pins for the step that starts at `time_s`, given the own rows' state. Call it if
    /// [`Pins::changes`]; returns the held rows.
    pub fn regrip(&mut self, time_s: f64, step_s: f64, positions: &[f32], velocities: &[f32]) -> Vec<u32> {
        for (pin, held) in self.pins.iter().zip(&mut self.held) {
            if !is_held((pin.start_s, pin.end_s), time_s, step_s) {
                *held = None;
            } else if held.is_none() {
                let at = pin.row as usize * 3;
                *held = Some(Held {
                    position: Vec3::from_slice(&positions[at..at + 3]),
                    velocity: Vec3::from_slice(&velocities[at..at + 3]),
                });
            }
        }
        self.pins.iter().zip(&self.held).filter(|(_, held)| held.is_some()).map(|(pin, _)| pin.row).collect()
    }

    /// Targets of the step from `time_s` to `time_s + step_s`; remembers them as the state at t1.
    pub fn targets(&mut self, time_s: f64, step_s: f64, paths: &PinPaths) -> PinTargets {
        let mut out = PinTargets::default();
        let motions = &paths.motions;
        let followed = paths.at(time_s + step_s);
        for (pin, held) in self.pins.iter().zip(&mut self.held) {
            let Some(held) = held else { continue };
            // A pin held from the beginning follows its motion directly, so that rounding errors do not accumulate.
            let (from, since) = if pin.start_s <= 0.0 {
                (DVec3::from_array(pin.start_m.map(f64::from)), 0.0)
            } else {
                (held.position.as_dvec3(), time_s)
            };
            let target = match (&pin.grip, pin.motion) {
                (Some(grip), _) => grip.point_of(&followed).as_vec3(),
                (None, Some(_)) => {
                    (from + (moved(pin, motions, time_s + step_s) - moved(pin, motions, since))).as_vec3()
                }
                (None, None) => held.position,
            };
            let velocity = (target - held.position) / step_s as f32;
            out.rows.push(pin.row);
            out.positions.push(target.to_array());
            out.velocities.push(velocity.to_array());
            out.velocity_changes.push((velocity - held.velocity).to_array());
            (held.position, held.velocity) = (target, velocity);
        }
        out
    }

    /// Displacement of every moving pin that is held in the step that starts at `time_s`, meters.
    pub fn ways<'a>(&'a self, time_s: f64, step_s: f64, paths: &'a PinPaths) -> impl Iterator<Item = DVec3> + 'a {
        let held = move |pin: &&RankPin| is_held((pin.start_s, pin.end_s), time_s, step_s);
        let times = [time_s, time_s + step_s];
        let followed = times.map(|time_s| paths.at(time_s));
        let way = move |pin: &RankPin| {
            let [start, end] = match &pin.grip {
                Some(grip) => [0, 1].map(|i| grip.point_of(&followed[i])),
                None => times.map(|time_s| moved(pin, &paths.motions, time_s)),
            };
            end - start
        };
        self.pins.iter().filter(held).filter(|pin| pin.motion.is_some()).map(way)
    }
}

/// True if a pin with the hold `span` (seconds) is held during the step that starts at `time_s`.
pub fn is_held(span: (f64, f64), time_s: f64, step_s: f64) -> bool {
    // Half a step of slack, so that a pin whose hold ends at a step's end is held through that step in spite of
    // rounding.
    time_s + 0.5 * step_s >= span.0 && time_s + 0.5 * step_s <= span.1
}

fn moved(pin: &RankPin, motions: &[Motion], time_s: f64) -> DVec3 {
    let start = DVec3::from_array(pin.start_m.map(f64::from));
    pin.motion.map_or(start, |m| motions[m as usize].transform_at(time_s).transform_point3(start))
}
