//! Schedules, the link-contention clock and predictions.

mod emulated_links;
mod predict;
mod schedule;
mod schedule_best;
