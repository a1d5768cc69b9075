//! Collision detection: triangle hash table, workload table, proximity, continuous collision detection
//! [Li et al. 2020, Sec. 4.2]. Nothing is here yet: `step.rs` marks the places where its results enter.
