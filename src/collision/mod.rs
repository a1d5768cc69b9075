//! Collision detection: triangle hash table, workload table, proximity, continuous collision detection
//! [Li et al. 2020, Sec. 4.2]. Only the elementary tests are here yet: `step.rs` marks the places where results enter.

pub mod elementary;
