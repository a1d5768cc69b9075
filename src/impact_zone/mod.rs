//! Impact zones: grouping on the master worker, distribution, solve [Li et al. 2020, Sec. 4.3; Harmon et al. 2008].
//! Nothing is here yet: `step.rs` marks the place where it enters.
