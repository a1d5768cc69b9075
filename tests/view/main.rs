//! The page of `loomtree view`: who is answered, and what a real browser shows.

mod browser;
mod page;
mod server;
