//! Command line: one file per command; `bin/` only calls in here.
