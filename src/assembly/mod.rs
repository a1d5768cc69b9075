//! Dynamic matrix assembly into sliced block ELL [Li et al. 2020, Sec. 3.2]: element records -> Index Table -> Value Table,
//! right-hand side and preconditioner of a rank's rows. Gathers per row, so no atomics and a fixed order of every sum.

mod element_rows;
pub mod fill;
mod fill_cpu;
mod layout;
mod pattern;
pub mod sell;

pub use element_rows::ElementRows;
pub use layout::{LANES, NO_ROW, SORT_WINDOW, SellLayout};
pub use pattern::{Pattern, RowTooLong};
pub use sell::SellMatrix;
