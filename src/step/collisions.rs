//! Collisions of a step, on every rank at once [Li et al. 2020, Sec. 4]: contacts before the solve, impact zones after
//! it.
//!
//! Every rank holds the positions of all vertices (12 bytes each, twice) and tests its even share of the pairs; what it
//! finds goes to all ranks. Lists are sorted before use and decisions are made by everybody from the same data, so
//! nothing depends on who found what or on the number of ranks.

use std::ops::Range;

use crate::collision::broad::{BroadError, CollisionMesh, Split};
use crate::collision::{ContactParams, Detector, DetectorError, Impact, RunsOn, merge_contacts, merge_impacts};
use crate::context::RankContext;
use crate::forces::{ContactElement, NO_VERTEX};
use crate::gpu::CpuExecutor;
use crate::impact_zone::{self, ImpactZones, Moved, StepPositions, ZoneSettings};
use crate::math::{DVec3, Vec3};
use crate::model::CollisionModel;
use crate::partition::{HaloPlan, RowPartition};
use crate::scene::Obstacles;
use crate::telemetry::EventName;
use crate::transport::{TracedTransport, Transport, TransportError, share_lists, share_positions};

use super::error::{Failure, Imposed, SetupError};
use super::let_go_pairs::{LetGoPairs, Pressed};
use super::normal_forces::NormalForces;
use super::span::Span;
use super::stats::{StageClock, StepStats};

/// The contacts of a step as one rank needs them.
pub(super) struct RankContacts {
    /// Contacts that touch own rows, in their global order; vertices are local.
    pub elements: Vec<ContactElement>,
    /// Halo plan with the rows that contacts add.
    pub plan: HaloPlan,
    /// Positions and velocities (over the step) of the obstacle vertices that contacts touch, xyz; they follow the
    /// plan's rows in the local numbering.
    pub obstacle_positions: Vec<f32>,
    pub obstacle_velocities: Vec<f32>,
}

/// How far [`Collisions::resolve`] goes before it asks for shorter steps.
#[derive(Clone, Copy)]
pub(super) struct Limits {
    /// Rounds of impact zones.
    pub rounds_most: u32,
    /// Whether steps get no shorter.
    pub at_last: bool,
}

/// The contacts of all ranks that touch own rows.
struct SharedContacts {
    /// Sorted, each once; vertices are global.
    elements: Vec<ContactElement>,
    /// See [`Collisions::pressed_from_both_sides`].
    pressed: Vec<Pressed>,
    /// Whether any rank has such vertices.
    any_pressed: bool,
}

/// How the end of a step was freed of penetrations.
pub(super) enum Resolved {
    /// Own rows (within the row block) that zones moved, and where to.
    Free(Vec<(u32, [f32; 3])>),
    /// Not within the rounds allowed: a shorter step has an easier end.
    Slow,
    /// Not at all: what the scene moves leaves no room.
    Squeezed(Vec<Imposed>),
    /// Not as it was: vertices between obstacles that overlap have been let go.
    LetGo,
}

/// Collision detection and response of one rank.
pub(super) struct Collisions {
    pub(super) model: CollisionModel,
    pub(super) obstacles: Obstacles,
    pub(super) detector: Detector,
    pub(super) cpu: CpuExecutor,
    pub(super) partition: RowPartition,
    /// Halo plan without contacts.
    pub(super) plan: HaloPlan,
    /// Positions of all vertices at the ends of the step, cloth rows, then obstacle vertices, xyz.
    pub(super) x_t0: Vec<f32>,
    pub(super) x_t1: Vec<f32>,
    /// Positions of the obstacles at some time, xyz.
    obstacle_positions: Vec<f32>,
    /// What friction goes by.
    normal_forces: NormalForces,
    /// Whether any vertex has friction.
    rough: bool,
    /// Whether `x_t0` holds the cloth's state.
    pub(super) state_known: bool,
    pub(super) let_go: LetGoPairs,
    /// Rows of all ranks that pins hold since they touched an obstacle, ascending.
    touching: Vec<u32>,
}

impl Collisions {
    /// Collisions of rank `plan.rank`; native code runs on `cpu`'s threads.
    ///
    /// # Errors
    /// The model's lists do not fit each other.
    pub(super) fn new(
        cpu: CpuExecutor,
        partition: RowPartition,
        plan: HaloPlan,
        mut model: CollisionModel,
        step_s: f64,
    ) -> Result<Collisions, SetupError> {
        let unfit = |what: String| SetupError::Collision(what);
        let obstacles = model.take_obstacles().ok_or_else(|| unfit("obstacles do not fit their header".into()))?;
        let rows = partition.rows();
        let vertices = rows + obstacles.vertices();
        let mut friction = std::mem::take(&mut model.arrays.friction);
        friction.extend((0..obstacles.vertices()).map(|v| obstacles.friction(obstacles.obstacle_of_vertex(v)) as f32));
        let cloth = std::mem::take(&mut model.arrays.triangles);
        let mut altitudes_m = vec![f32::MAX; vertices];
        for (corners, altitude_m) in cloth.iter().zip(std::mem::take(&mut model.arrays.altitudes_m)) {
            for &v in corners {
                altitudes_m[v as usize] = altitudes_m[v as usize].min(altitude_m);
            }
        }
        let mut triangles = cloth;
        triangles.extend(obstacles.triangles().iter().map(|corners| corners.map(|v| v + rows as u32)));
        let mesh = CollisionMesh::new(vertices, rows, triangles).map_err(|error| unfit(error.to_string()))?;
        let mut inverse_masses = vec![0.0; vertices];
        model.inverse_masses(0.0, step_s, &[], &mut inverse_masses[..rows]);
        let params = ContactParams {
            thickness_m: model.thickness_m as f32,
            separation_m: 0.0,
            stiffness_ratio: model.stiffness as f32,
            step_s: step_s as f32,
            friction,
            inverse_masses_per_kg: inverse_masses,
            smallest_altitudes_m: altitudes_m,
            friction_factors: std::mem::take(&mut model.arrays.friction_factors),
            thickness_factors: std::mem::take(&mut model.arrays.thickness_factors),
        };
        let rough = params.friction.iter().any(|&friction| friction > 0.0);
        let normal_forces = NormalForces::new(partition.rows_of(plan.rank), rows);
        let mut detector = Detector::new(mesh, params).map_err(|error| unfit(error.to_string()))?;
        detector.limit_memory(model.memory_limit_bytes);
        detector.sew(&std::mem::take(&mut model.arrays.sewn), &std::mem::take(&mut model.arrays.near_sewn));
        Ok(Collisions {
            detector,
            cpu,
            partition,
            plan,
            x_t0: vec![0.0; vertices * 3],
            x_t1: vec![0.0; vertices * 3],
            obstacle_positions: Vec::new(),
            state_known: false,
            normal_forces,
            rough,
            let_go: LetGoPairs::new(&obstacles, step_s),
            touching: Vec::new(),
            obstacles,
            model,
        })
    }

    /// Tells all ranks which own rows (within the row block) pins hold since they touched an obstacle, if the scene has
    /// such pins.
    pub(super) fn share_touching(&mut self, rank: &mut RankContext<'_>, own: &[u32]) -> Result<(), TransportError> {
        if !self.model.pins.iter().any(|pin| pin.on_touch) {
            return Ok(());
        }
        let first = self.partition.rows_of(self.plan.rank).start as u32;
        let own: Vec<u32> = own.iter().map(|row| row + first).collect();
        let touching = &mut self.touching;
        touching.clear();
        share_lists(rank.transport, &own, &mut |_, part: &[u32]| touching.extend_from_slice(part))?;
        touching.sort_unstable();
        Ok(())
    }

    /// Displacements of the obstacles' vertices from one time to another, meters.
    pub(super) fn obstacle_ways(&self, start_s: f64, end_s: f64) -> Vec<DVec3> {
        let (mut starts, mut ends) = (Vec::new(), Vec::new());
        self.obstacles.positions_at(start_s, &mut starts);
        self.obstacles.positions_at(end_s, &mut ends);
        let at = |x: &[f32; 3]| DVec3::from_array(x.map(f64::from));
        let pairs = starts.as_chunks::<3>().0.iter().zip(ends.as_chunks::<3>().0);
        pairs.map(|(start, end)| at(end) - at(start)).collect()
    }

    /// Bytes held besides the tables of queries: mesh, positions, masses.
    pub(super) fn mesh_bytes(&self) -> u64 {
        4 * (self.x_t0.len() + self.x_t1.len() + self.model.arrays.masses.len()) as u64
    }

    /// Tells the detector who is pinned and how long the step is.
    fn set_step(&mut self, span: Span) -> Result<(), DetectorError> {
        let rows = self.partition.rows();
        let params = self.detector.params();
        let mut inverse_masses = params.inverse_masses_per_kg.clone();
        self.model.inverse_masses(span.start_s, span.length_s, &self.touching, &mut inverse_masses[..rows]);
        if params.step_s == span.length_s as f32 && params.inverse_masses_per_kg == inverse_masses {
            return Ok(());
        }
        let params =
            ContactParams { step_s: span.length_s as f32, inverse_masses_per_kg: inverse_masses, ..params.clone() };
        self.detector.set_params(params)
    }

    /// Obstacles at both ends of `span`, pinned vertices; finds the contacts of the state at its start, whose own rows
    /// are `own` (positions, velocities; xyz), and those it is heading for, and tells everybody who needs which rows.
    pub(super) fn contacts(
        &mut self,
        rank: &mut RankContext<'_>,
        own: (&[f32], &[f32]),
        gravity_m_s2: [f32; 3],
        span: Span,
        stats: &mut StepStats,
    ) -> Result<RankContacts, Failure> {
        let clock = StageClock::start();
        if !self.state_known {
            self.share_let_go(rank)?;
        }
        let (query, share) = (EventName::ProximityQuery, EventName::SharePositions);
        let mut traced = TracedTransport::new(rank.transport, rank.recorder, query, share);
        if !self.state_known {
            share_positions(&mut traced, own.0, &mut self.x_t0, |rank| values_of(&self.partition, rank))?;
            self.state_known = true;
        }
        let cloth = self.partition.rows() * 3;
        for (time_s, x) in [(span.start_s, &mut self.x_t0), (span.end_s, &mut self.x_t1)] {
            self.obstacles.positions_at(time_s, &mut self.obstacle_positions);
            x[cloth..].copy_from_slice(&self.obstacle_positions);
        }
        self.set_step(span).map_err(|error| detection(stats.step, error))?;
        let ahead = self.heading_for(own, gravity_m_s2, span);
        if let Some(at) = ahead.iter().position(|x| !x.is_finite()) {
            return Err(Failure::NotFinite {
                step: stats.step,
                row: (self.partition.rows_of(self.plan.rank).start + at / 3) as u32,
                quantity: "position".into(),
                cause: "where its velocity takes it".into(),
                suspect: "simulation.step_s or a velocity".into(),
            });
        }
        share_positions(&mut traced, &ahead, &mut self.x_t1, |rank| values_of(&self.partition, rank))?;
        traced.finish(0);
        let mut elements = loop {
            let mut traced = TracedTransport::new(rank.transport, rank.recorder, query, EventName::ShareQuery);
            let mut found = Vec::new();
            let on = RunsOn::new(rank.executor, &self.cpu);
            let query = self
                .detector
                .contacts_ahead(on, &self.x_t0, &self.x_t1, &mut Split::together(&mut traced), &mut found)
                .map_err(|error| detection_failed(stats.step, &self.obstacles, self.partition.rows(), error))?;
            stats.proximity.add(&query);
            stats.query_bytes[0] = stats.query_bytes[0].max(query.bytes);
            stats.collision_mesh_bytes = query.replicated_bytes + self.mesh_bytes();
            traced.finish(query.bytes);
            clock.lap(&mut stats.seconds.proximity);
            rank.transport.alive()?;
            let counted = stats.contacts;
            let shared = self.share_contacts(rank, &found, query.smallest_gap_m, stats)?;
            if !shared.any_pressed || self.let_go_pressed(rank, &shared.pressed, stats)? == 0 {
                break shared.elements;
            }
            // Once more without them; each time a pair more, of finitely many.
            stats.contacts = counted;
        };
        if self.rough {
            let inverse_masses = &self.detector.params().inverse_masses_per_kg;
            let fall_m = Vec3::from(gravity_m_s2) * (span.length_s * span.length_s) as f32;
            let falls = |v: u32| inverse_masses[v as usize] > 0.0;
            let ratio = self.model.stiffness as f32;
            self.normal_forces.take_first(&elements, &self.x_t0, &self.x_t1, fall_m, falls, ratio);
        }
        self.find_ways_out(&elements);
        self.add_ways_out(&mut elements);
        let contacts = self.localize(rank, elements, span)?;
        clock.lap(&mut stats.seconds.contacts);
        Ok(contacts)
    }

    /// The contacts of this step anew, for a better guess of its end, and how many all ranks have; friction stays with
    /// those that the first solve has found the forces of. `own` holds the own rows' positions there, xyz.
    pub(super) fn contacts_again(
        &mut self,
        rank: &mut RankContext<'_>,
        own: &[f32],
        span: Span,
        stats: &mut StepStats,
    ) -> Result<(RankContacts, u64), Failure> {
        let clock = StageClock::start();
        let (query, share) = (EventName::ProximityQuery, EventName::SharePositions);
        let mut traced = TracedTransport::new(rank.transport, rank.recorder, query, share);
        share_positions(&mut traced, own, &mut self.x_t1, |rank| values_of(&self.partition, rank))?;
        stats.state_bytes += 4 * (self.partition.rows() * 3 - own.len()) as u64;
        let mut found = Vec::new();
        self.detector.contacts_again(&self.cpu, &self.x_t0, &self.x_t1, &mut found);
        traced.finish(0);
        clock.lap(&mut stats.seconds.proximity);
        rank.transport.alive()?;
        let counted = stats.contacts;
        let mut elements = self.share_contacts(rank, &found, f32::INFINITY, stats)?.elements;
        let count = std::mem::replace(&mut stats.contacts, counted) - counted;
        if self.rough {
            self.normal_forces.first_ends(&self.x_t0, &self.x_t1);
            let ratio = self.model.stiffness as f32;
            self.normal_forces.take_again(&elements, &self.x_t0, &self.x_t1, ratio);
            let mut traced = TracedTransport::new(rank.transport, rank.recorder, query, share);
            let own = self.partition.rows_of(self.plan.rank);
            let scales = self.normal_forces.scale[own].to_vec();
            share_positions(&mut traced, &scales, &mut self.normal_forces.scale, |rank| self.partition.rows_of(rank))?;
            traced.finish(0);
            self.normal_forces.scale(&mut elements);
        }
        self.add_ways_out(&mut elements);
        let contacts = self.localize(rank, elements, span)?;
        clock.lap(&mut stats.seconds.contacts);
        Ok((contacts, count))
    }

    /// What all ranks found, as this rank needs it.
    fn share_contacts(
        &self,
        rank: &mut RankContext<'_>,
        found: &[ContactElement],
        smallest_gap_m: f32,
        stats: &mut StepStats,
    ) -> Result<SharedContacts, Failure> {
        let mut traced =
            TracedTransport::new(rank.transport, rank.recorder, EventName::LocalContacts, EventName::ShareContacts);
        let shared = self.own_contacts(&mut traced, found, smallest_gap_m, stats)?;
        traced.finish(0);
        Ok(shared)
    }

    /// Where the own rows would be at the end of `span` if nothing but gravity acted on them.
    fn heading_for(&self, (x, v): (&[f32], &[f32]), gravity_m_s2: [f32; 3], span: Span) -> Vec<f32> {
        let step_s = span.length_s as f32;
        let rows = self.partition.rows_of(self.plan.rank);
        let mobile = &self.detector.params().inverse_masses_per_kg[rows];
        let mut ahead = Vec::with_capacity(x.len());
        for (i, (x, v)) in x.iter().zip(v).enumerate() {
            let falls = if mobile[i / 3] > 0.0 { step_s * gravity_m_s2[i % 3] } else { 0.0 };
            ahead.push(x + step_s * (v + falls));
        }
        ahead
    }

    /// Contacts of all ranks that touch own rows, sorted, each once.
    fn own_contacts(
        &self,
        transport: &mut dyn Transport,
        found: &[ContactElement],
        smallest_gap_m: f32,
        stats: &mut StepStats,
    ) -> Result<SharedContacts, Failure> {
        let own = self.partition.rows_of(self.plan.rank);
        let mut lists = vec![Vec::new(); transport.ranks()];
        share_lists(transport, found, &mut |source, part: &[ContactElement]| {
            lists[source].extend(part.iter().filter(|c| c.vertices.iter().any(|&v| own.contains(&(v as usize)))));
        })?;
        let elements = merge_contacts(&lists.iter().map(Vec::as_slice).collect::<Vec<_>>());
        // A contact is counted by the owner of its first cloth vertex.
        let rows = self.partition.rows() as u32;
        let first = |c: &ContactElement| c.vertices.into_iter().find(|&v| v < rows).unwrap_or(NO_VERTEX);
        let counted = elements.iter().filter(|c| own.contains(&(first(c) as usize))).count();
        let pressed = self.pressed_from_both_sides(&elements);
        let mut all = Vec::new();
        transport.all_gather(&[counted as f64, f64::from(smallest_gap_m), pressed.len() as f64], &mut all)?;
        stats.contacts += all.iter().map(|of_rank| of_rank[0] as u64).sum::<u64>();
        let gap = all.iter().map(|of_rank| of_rank[1] as f32).fold(f32::INFINITY, f32::min);
        let before = stats.smallest_gap_m.unwrap_or(f32::INFINITY);
        stats.smallest_gap_m = Some(gap.min(before)).filter(|gap| gap.is_finite());
        let any_pressed = all.iter().any(|of_rank| of_rank[2] > 0.0);
        Ok(SharedContacts { elements, pressed, any_pressed })
    }

    /// Global vertices to local ones: extends the halo on all ranks.
    fn localize(
        &self,
        rank: &mut RankContext<'_>,
        mut elements: Vec<ContactElement>,
        span: Span,
    ) -> Result<RankContacts, Failure> {
        let mut traced =
            TracedTransport::new(rank.transport, rank.recorder, EventName::LocalContacts, EventName::ShareContacts);
        let transport = &mut traced;
        let rows = self.partition.rows() as u32;
        let vertices = || elements.iter().flat_map(|c| c.vertices).filter(|&v| v != NO_VERTEX);
        let sorted = |mut list: Vec<u32>| {
            list.sort_unstable();
            list.dedup();
            list
        };
        let own = self.partition.rows_of(self.plan.rank);
        let lacking = |v: &u32| !own.contains(&(*v as usize)) && self.plan.local_from_global(*v).is_none();
        let needed = sorted(vertices().filter(|&v| v < rows).filter(lacking).collect());
        let touched = sorted(vertices().filter(|&v| v >= rows).collect());
        let mut needs = vec![Vec::new(); transport.ranks()];
        share_lists(transport, &needed, &mut |source, part: &[u32]| needs[source].extend_from_slice(part))?;
        let plan = self.plan.extended(&self.partition, &needs);
        for v in elements.iter_mut().flat_map(|c| &mut c.vertices).filter(|v| **v != NO_VERTEX) {
            *v = if own.contains(&(*v as usize)) {
                (plan.own.start + *v as usize - own.start) as u32
            } else if *v < rows {
                plan.local_from_global(*v).expect("the plan was extended by this row")
            } else {
                let place = touched.binary_search(v).expect("obstacle vertices were collected from these elements");
                (plan.local_rows + place) as u32
            };
        }
        let of = |x: &[f32]| touched.iter().flat_map(|&v| x[v as usize * 3..][..3].to_vec()).collect::<Vec<f32>>();
        let (obstacle_positions, ends) = (of(&self.x_t0), of(&self.x_t1));
        let rate = (1.0 / span.length_s) as f32;
        let obstacle_velocities =
            ends.iter().zip(&obstacle_positions).map(|(end, start)| (end - start) * rate).collect();
        traced.finish(0);
        Ok(RankContacts { elements, plan, obstacle_positions, obstacle_velocities })
    }

    /// Continuous detection from the start of the step to `own` (own rows' candidate positions, xyz) and impact zones
    /// until nothing penetrates; in at most as many rounds as `limits` says, twice as many while the impacts become few
    /// or half as many.
    pub(super) fn resolve(
        &mut self,
        rank: &mut RankContext<'_>,
        own: &[f32],
        span: Span,
        limits: Limits,
        stats: &mut StepStats,
    ) -> Result<Resolved, Failure> {
        let clock = StageClock::start();
        let (query, share) = (EventName::ContinuousQuery, EventName::SharePositions);
        let mut traced = TracedTransport::new(rank.transport, rank.recorder, query, share);
        share_positions(&mut traced, own, &mut self.x_t1, |rank| values_of(&self.partition, rank))?;
        traced.finish(0);
        stats.state_bytes += 4 * (self.partition.rows() * 3 - own.len()) as u64;
        clock.lap(&mut stats.seconds.positions);
        let mut settings = ZoneSettings::for_thickness(self.model.thickness_m);
        settings.margin_m = self.model.margin_m.map_or(settings.margin_m, |margin_m| margin_m.min(settings.margin_m));
        let mut zones = ImpactZones::new(settings);
        let mut touched: Option<Vec<bool>> = None;
        let (mut most, mut last) = (0, usize::MAX);
        loop {
            let impacts = self.impacts(rank, touched.as_deref(), stats)?;
            clock.lap(&mut stats.seconds.continuous);
            if impacts.is_empty() {
                break;
            }
            most = most.max(impacts.len());
            let ends_soon = impacts.len() <= (last / 2).max(most / 16);
            let rounds_most = limits.rounds_most.saturating_mul(if ends_soon { 2 } else { 1 });
            if zones.counts().rounds >= rounds_most {
                stats.zones.add(&zones.counts());
                return Ok(Resolved::Slow);
            }
            last = impacts.len();
            let mut traced =
                TracedTransport::new(rank.transport, rank.recorder, EventName::ImpactZones, EventName::ShareMoved);
            let inverse_masses = &self.detector.params().inverse_masses_per_kg;
            let step = StepPositions { x_t0: &self.x_t0, x_t1: &self.x_t1, inverse_masses };
            if let Err(impossible) = zones.add(&step, &impacts) {
                stats.zones.add(&zones.counts());
                if self.let_go_of(&impossible, span, limits.at_last, stats) > 0 {
                    return Ok(Resolved::LetGo);
                }
                return Ok(Resolved::Squeezed(self.imposed(&impossible.imposed)));
            }
            let share = zones.share(traced.rank(), traced.ranks());
            let solved = zones.solve(rank.executor, &self.cpu, &step, &share);
            stats.zones.iterations += solved.iterations;
            let mask = touched.get_or_insert_with(Vec::new);
            mask.clear();
            mask.resize(self.x_t0.len() / 3, false);
            let x_t1 = &mut self.x_t1;
            share_lists(&mut traced, &solved.moved, &mut |_, part: &[Moved]| {
                impact_zone::apply(part, x_t1);
                part.iter().for_each(|one| mask[one.vertex as usize] = true);
            })?;
            traced.finish(0);
            clock.lap(&mut stats.seconds.zones);
        }
        stats.zones.add(&zones.counts());
        Ok(Resolved::Free(self.accept(own)))
    }

    /// What holds the vertices that cannot be resolved.
    fn imposed(&self, vertices: &[u32]) -> Vec<Imposed> {
        let rows = self.partition.rows();
        let mut imposed: Vec<Imposed> = vertices
            .iter()
            .map(|&v| match (v as usize).checked_sub(rows) {
                Some(v) => Imposed::Obstacle(self.obstacles.name(self.obstacles.obstacle_of_vertex(v)).to_string()),
                None => Imposed::Pin(v),
            })
            .collect();
        imposed.sort();
        imposed.dedup();
        imposed
    }

    /// The end of the step becomes the known state; own rows that differ from `own`.
    fn accept(&mut self, own: &[f32]) -> Vec<(u32, [f32; 3])> {
        let rows = self.partition.rows_of(self.plan.rank);
        let (ends, _) = self.x_t1[rows.start * 3..rows.end * 3].as_chunks::<3>();
        let (candidates, _) = own.as_chunks::<3>();
        let moved = ends.iter().zip(candidates).enumerate().filter(|(_, (end, candidate))| end != candidate);
        let moved = moved.map(|(row, (end, _))| (row as u32, *end)).collect();
        std::mem::swap(&mut self.x_t0, &mut self.x_t1);
        moved
    }

    /// Impacts of all ranks, sorted, each once.
    fn impacts(
        &mut self,
        rank: &mut RankContext<'_>,
        touched: Option<&[bool]>,
        stats: &mut StepStats,
    ) -> Result<Vec<Impact>, Failure> {
        let (query, share) = (EventName::ContinuousQuery, EventName::ShareQuery);
        let mut traced = TracedTransport::new(rank.transport, rank.recorder, query, share);
        let mut found = Vec::new();
        let on = RunsOn::new(rank.executor, &self.cpu);
        let split = &mut Split::together(&mut traced);
        let query = self
            .detector
            .impacts(on, &self.x_t0, &self.x_t1, touched, split, &mut found)
            .map_err(|error| detection_failed(stats.step, &self.obstacles, self.partition.rows(), error))?;
        stats.continuous.add(&query);
        stats.query_bytes[1] = stats.query_bytes[1].max(query.bytes);
        traced.alive()?;
        traced.shares(EventName::ShareImpacts);
        let mut lists = vec![Vec::new(); traced.ranks()];
        share_lists(&mut traced, &found, &mut |source, part: &[Impact]| lists[source].extend_from_slice(part))?;
        let impacts = merge_impacts(&lists.iter().map(Vec::as_slice).collect::<Vec<_>>());
        traced.finish(query.bytes);
        Ok(impacts)
    }
}

/// Values of the rows of `rank` in a vector over the whole cloth.
fn values_of(partition: &RowPartition, rank: usize) -> Range<usize> {
    let rows = partition.rows_of(rank);
    rows.start * 3..rows.end * 3
}

fn detection(step: u32, cause: impl std::fmt::Display) -> Failure {
    Failure::in_step(step, format_args!("collision detection: {cause}"))
}

/// Says which vertex of which mesh detection cannot work with; `rows` of the cloth precede the obstacles' vertices.
fn detection_failed(step: u32, obstacles: &Obstacles, rows: usize, error: BroadError) -> Failure {
    let (which, vertex, value_m) = match error {
        BroadError::Position { which, vertex, value_m } => (which, vertex, value_m),
        BroadError::Transport(error) => return error.into(),
        error => return detection(step, error),
    };
    match vertex.checked_sub(rows) {
        None => Failure::NotFinite {
            step,
            row: vertex as u32,
            quantity: "position".into(),
            cause: format!("{value_m} m at the {which} of the step, more than collisions are computed for"),
            suspect: "simulation.step_s or a velocity".into(),
        },
        Some(at) => {
            let name = obstacles.name(obstacles.obstacle_of_vertex(at));
            detection(
                step,
                format_args!("the obstacle `{name}` is {value_m} m from the origin at the {which} of the step"),
            )
        }
    }
}
