//! Held vertices of a rank: those held at a time, and their targets. Host only, because a cloth has few of them.
//!
//! A pin moves by the *change* of its motion since it took hold, so a pin that takes hold later does not jump. A hard
//! pin prescribes its vertex; a soft one is a spring from the vertex to the target. Targets depend on the scene and the
//! state at t0 only, never on earlier steps, so a resumed run gives the same bits. What a pin takes hold of while the
//! cloth moves (an obstacle, or for a soft pin a place) is a [`Hold`], a part of the state.

use std::rc::Rc;

use super::surfaces::Surfaces;
use crate::math::{DVec3, Vec3};
use crate::scene::{Grip, Hold, Motion, Obstacles};

/// Value of a row of `System::pinned` that a pin prescribes; others have the dt^2 k of their spring there, kg, or 0.
pub const PRESCRIBED: f32 = -1.0;

/// A pin on an own row.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RankPin {
    /// Own row.
    pub row: u32,
    /// Start position of the vertex, meters.
    pub start_m: [f32; 3],
    /// Motion of a moving pin; not used by one that follows an obstacle.
    pub motion: Option<u32>,
    /// Place on a triangle of the followed obstacles, which the vertex keeps.
    pub grip: Option<Grip>,
    /// Start of the hold, seconds.
    pub start_s: f64,
    /// End of the hold, seconds.
    pub end_s: f64,
    /// Stiffness of the spring, N/m; none prescribes the vertex.
    pub stiffness_n_m: Option<f64>,
    /// True if the hold begins where the vertex touches the obstacle.
    pub on_touch: bool,
    /// True if what it is held at follows from the state when the hold begins ([`Hold`]).
    pub takes_hold_later: bool,
    /// Triangles of [`Surfaces`] of which it then takes hold, first and end; none for a place in space.
    pub surface: Option<[u32; 2]>,
}

impl RankPin {
    fn spans(&self, time_s: f64, step_s: f64) -> bool {
        is_held((self.start_s, self.end_s), time_s, step_s)
    }
}

/// What the pins of a rank move with.
#[derive(Clone, Debug, Default)]
pub struct PinPaths {
    /// Motions of the scene.
    pub motions: Vec<Motion>,
    /// Vertices of obstacles that grips name.
    pub followed: Obstacles,
    /// Obstacles that pins take hold of while the cloth moves.
    pub surfaces: Surfaces,
    /// Distance within which a vertex touches an obstacle, meters.
    pub touch_m: f64,
}

impl PinPaths {
    /// The followed vertices at a time, xyz.
    fn at(&self, time_s: f64) -> Vec<f32> {
        let mut values = Vec::new();
        self.followed.positions_at(time_s, &mut values);
        values
    }
}

/// State of a prescribed row at t0.
#[derive(Clone, Copy, Debug)]
struct Held {
    position: Vec3,
    velocity: Vec3,
}

/// The obstacle vertices that the holds of a rank name.
#[derive(Debug, Default)]
struct HeldCorners {
    /// Their numbers in the scene, ascending.
    vertices: Vec<u32>,
    obstacles: Obstacles,
}

/// All pins of a rank.
#[derive(Clone, Debug)]
pub struct Pins {
    pins: Vec<RankPin>,
    held: Vec<Option<Held>>,
    /// Of pins that take hold later, while they hold.
    holds: Vec<Option<Hold>>,
    /// Holds of a state that was set, until the time tells whose they are.
    unclaimed: Vec<Hold>,
    corners: Rc<HeldCorners>,
}

/// Rows to hold in a step, with their targets.
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
    /// Springs of soft pins, in the order of the pins.
    pub springs: Vec<Spring>,
}

/// Spring of a soft pin: force stiffness (target - position).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spring {
    /// Own row.
    pub row: u32,
    /// At t1, meters.
    pub target_m: [f32; 3],
    /// N/m.
    pub stiffness_n_m: f32,
}

impl Pins {
    /// Pins of a rank, none of them held yet.
    pub fn new(pins: Vec<RankPin>) -> Pins {
        let (held, holds) = (vec![None; pins.len()], vec![None; pins.len()]);
        Pins { held, holds, unclaimed: Vec::new(), corners: Rc::default(), pins }
    }

    /// True if a pin of the rank is a spring.
    pub fn has_springs(&self) -> bool {
        self.pins.iter().any(|pin| pin.stiffness_n_m.is_some())
    }

    /// Holds of the state at the end of the last step, ascending by own row.
    pub fn holds(&self) -> Vec<Hold> {
        let mut holds: Vec<Hold> = self.holds.iter().flatten().chain(&self.unclaimed).copied().collect();
        holds.sort_unstable_by_key(|hold| hold.vertex);
        holds
    }

    /// Own rows that are prescribed since they touched an obstacle, ascending.
    pub fn touching(&self) -> Vec<u32> {
        let is_prescribed = |pin: &RankPin| pin.on_touch && pin.stiffness_n_m.is_none();
        let mut rows: Vec<u32> = self
            .pins
            .iter()
            .zip(&self.holds)
            .filter(|(pin, hold)| is_prescribed(pin) && hold.is_some())
            .map(|(pin, _)| pin.row)
            .collect();
        rows.sort_unstable();
        rows
    }

    /// True if [`Pins::take_hold`] has something to do in the step that starts at `time_s`.
    pub fn waits(&self, time_s: f64, step_s: f64) -> bool {
        let waits = |(pin, hold): (&RankPin, &Option<Hold>)| {
            pin.takes_hold_later && pin.spans(time_s, step_s) != hold.is_some()
        };
        !self.unclaimed.is_empty() || self.pins.iter().zip(&self.holds).any(waits)
    }

    /// Takes hold of obstacles and places, and lets go of them, for the step that starts at `time_s` with the own rows
    /// at `positions`, xyz.
    pub fn take_hold(&mut self, time_s: f64, step_s: f64, paths: &PinPaths, positions: &[f32]) {
        let known = |hold: &Hold| {
            hold.grip().is_none_or(|grip| grip.vertices.iter().all(|&v| paths.surfaces.local(v).is_some()))
        };
        self.unclaimed.retain(known);
        let point = |row: u32| Vec3::from_slice(&positions[3 * row as usize..]).as_dvec3();
        // Pins that wait for the same obstacle, by its triangles.
        let mut waiting: Vec<([u32; 2], bool, Vec<usize>)> = Vec::new();
        let mut changed = false;
        for (i, (pin, hold)) in self.pins.iter().zip(&mut self.holds).enumerate() {
            if !pin.takes_hold_later {
                continue;
            }
            let spans = pin.spans(time_s, step_s);
            if !spans || hold.is_some() {
                changed |= !spans && hold.take().is_some();
                continue;
            }
            if let Some(place) = self.unclaimed.iter().position(|one| one.vertex == pin.row) {
                *hold = Some(self.unclaimed.swap_remove(place));
                changed = true;
            } else if let Some(range) = pin.surface {
                match waiting.iter_mut().find(|(other, on_touch, _)| (*other, *on_touch) == (range, pin.on_touch)) {
                    Some((_, _, pins)) => pins.push(i),
                    None => waiting.push((range, pin.on_touch, vec![i])),
                }
            } else {
                let offset = point(pin.row) - moved(pin, &paths.motions, time_s);
                let (corners, weights) = (Hold::NO_TRIANGLE, [0.0; 3]);
                *hold = Some(Hold { vertex: pin.row, corners, weights, offset_m: offset.as_vec3().to_array() });
            }
        }
        self.unclaimed.clear();
        let surfaces = if waiting.is_empty() { Vec::new() } else { paths.surfaces.at(time_s) };
        for (range, on_touch, pins) in waiting {
            let points: Vec<(u32, DVec3)> = pins.iter().map(|&i| (self.pins[i].row, point(self.pins[i].row))).collect();
            let reach_m = if on_touch { paths.touch_m } else { f64::INFINITY };
            for (i, hold) in pins.into_iter().zip(paths.surfaces.holds(range, &surfaces, &points, reach_m)) {
                changed |= hold.is_some();
                self.holds[i] = hold;
            }
        }
        if changed {
            self.corners = Rc::new(HeldCorners::of(&self.holds, &paths.surfaces));
        }
    }

    /// Lets go of what the next step will not hold, so that the state at `time_s` does not name it.
    pub fn let_go(&mut self, time_s: f64, step_s: f64) {
        for (pin, hold) in self.pins.iter().zip(&mut self.holds) {
            if !pin.spans(time_s, step_s) {
                *hold = None;
            }
        }
    }

    /// True if the set of prescribed rows changes in the step that starts at `time_s`, which it always does in the
    /// first step from a state that was set. Call it after [`Pins::take_hold`].
    pub fn changes(&self, time_s: f64, step_s: f64) -> bool {
        (0..self.pins.len()).any(|i| self.is_prescribed(i, time_s, step_s) != self.held[i].is_some())
    }

    /// True if pin `i` prescribes its row in the step that starts at `time_s`.
    fn is_prescribed(&self, i: usize, time_s: f64, step_s: f64) -> bool {
        let pin = &self.pins[i];
        pin.stiffness_n_m.is_none() && pin.spans(time_s, step_s) && (!pin.takes_hold_later || self.holds[i].is_some())
    }

    /// Releases all pins, because another state has been set, whose holds are these. The next step takes hold of the
    /// pins that are due.
    pub fn set_holds(&mut self, holds: &[Hold]) {
        self.held.fill(None);
        self.holds.fill(None);
        self.unclaimed = holds.to_vec();
        self.corners = Rc::default();
    }

    /// Takes hold of and releases prescribed rows for the step that starts at `time_s`, given the own rows' state. Call
    /// it if [`Pins::changes`]; returns the prescribed rows.
    pub fn regrip(&mut self, time_s: f64, step_s: f64, positions: &[f32], velocities: &[f32]) -> Vec<u32> {
        for i in 0..self.pins.len() {
            if !self.is_prescribed(i, time_s, step_s) {
                self.held[i] = None;
            } else if self.held[i].is_none() {
                let at = self.pins[i].row as usize * 3;
                self.held[i] = Some(Held {
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
        let end_s = time_s + step_s;
        let (followed, corners) = (paths.at(end_s), self.corners.at(end_s));
        for ((pin, held), hold) in self.pins.iter().zip(&mut self.held).zip(&self.holds) {
            let kept = pin.grip.map(|grip| grip.point_of(&followed)).or_else(|| {
                let grip = hold.as_ref()?.grip()?;
                Some(self.corners.place(&grip, &corners))
            });
            if let Some(stiffness) = pin.stiffness_n_m {
                if !pin.spans(time_s, step_s) || (pin.takes_hold_later && hold.is_none()) {
                    continue;
                }
                let of_hold = |hold: &Hold| Vec3::from(hold.offset_m).as_dvec3();
                let target = kept.unwrap_or_else(|| {
                    moved(pin, motions, end_s)
                        + hold.as_ref().map_or_else(
                            || DVec3::from_array(pin.start_m.map(f64::from)) - moved(pin, motions, 0.0),
                            of_hold,
                        )
                });
                let (row, target_m) = (pin.row, target.as_vec3().to_array());
                out.springs.push(Spring { row, target_m, stiffness_n_m: stiffness as f32 });
                continue;
            }
            let Some(held) = held else { continue };
            // A pin held from the beginning follows its motion directly, so that rounding errors do not accumulate.
            let (from, since) = if pin.start_s <= 0.0 {
                (DVec3::from_array(pin.start_m.map(f64::from)), 0.0)
            } else {
                (held.position.as_dvec3(), time_s)
            };
            let target = match (kept, pin.motion) {
                (Some(kept), _) => kept.as_vec3(),
                (None, Some(_)) => (from + (moved(pin, motions, end_s) - moved(pin, motions, since))).as_vec3(),
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
        let held = move |(pin, _): &(&RankPin, &Option<Hold>)| pin.spans(time_s, step_s);
        let times = [time_s, time_s + step_s];
        let followed = times.map(|time_s| paths.at(time_s));
        let corners = times.map(|time_s| self.corners.at(time_s));
        let way = move |(pin, hold): (&RankPin, &Option<Hold>)| {
            let [start, end] = match (&pin.grip, hold.as_ref().and_then(Hold::grip)) {
                (Some(grip), _) => [0, 1].map(|i| grip.point_of(&followed[i])),
                (None, Some(grip)) => [0, 1].map(|i| self.corners.place(&grip, &corners[i])),
                (None, None) if pin.surface.is_some() => [DVec3::ZERO; 2],
                (None, None) => times.map(|time_s| moved(pin, &paths.motions, time_s)),
            };
            end - start
        };
        self.pins.iter().zip(&self.holds).filter(held).filter(|(pin, _)| pin.motion.is_some()).map(way)
    }
}

impl HeldCorners {
    fn of(holds: &[Option<Hold>], surfaces: &Surfaces) -> HeldCorners {
        let named = holds.iter().flatten().filter(|hold| hold.corners != Hold::NO_TRIANGLE);
        let mut vertices: Vec<u32> = named.flat_map(|hold| hold.corners).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let local: Vec<u32> = vertices.iter().filter_map(|&vertex| surfaces.local(vertex)).collect();
        HeldCorners { obstacles: surfaces.obstacles.only(&local), vertices }
    }

    /// Positions of the corners at a time, xyz.
    fn at(&self, time_s: f64) -> Vec<f32> {
        let mut values = Vec::new();
        self.obstacles.positions_at(time_s, &mut values);
        values
    }

    /// Where a grip of the scene's numbering is when the corners are at `positions`, xyz.
    fn place(&self, grip: &Grip, positions: &[f32]) -> DVec3 {
        let local = grip.vertices.map(|vertex| self.vertices.partition_point(|&other| other < vertex) as u32);
        grip.on(local).point_of(positions)
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
