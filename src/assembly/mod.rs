//! Dynamic matrix assembly into sliced block ELL [Li et al. 2020, Sec. 3.2]: element records -> Index Table -> Value
//! Table, right-hand side and preconditioner of a rank's rows. Each row gathers its contributions, so that every sum
//! has a fixed order without atomics.

mod element_rows;
pub mod fill;
mod fill_cpu;
mod index_fill;
mod index_fill_cpu;
mod layout;
pub mod contact_fill;
mod contact_fill_cpu;
mod contact_rows;
pub mod contact_system;
pub mod sell;

pub use contact_system::{ContactRecords, ContactSystem};
pub use element_rows::{ElementRows, RowLists};
pub use index_fill::{NO_POSITION, Numbering, RowTooLong, SubVectors};
pub use layout::{LANES, NO_ROW, SORT_WINDOW, SellLayout};
pub use sell::{SellMatrix, SystemMatrix};
