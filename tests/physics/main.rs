//! Motion with known answers, with and without contact.

mod air;
mod contact_curved;
mod contact_edge;
mod contact_energy;
mod contact_friction;
mod contact_rolling;
mod contact_scenes;
mod creases;
mod follow;
mod limits;
mod maps;
mod motion;
mod over_time;
mod overlaps;
mod pins;
mod plates;
mod rest;
mod seams;
mod soft_pins;
mod stiff;
mod stretches;
mod substeps;
mod system;
