//! Collision detection, impact zones and untangling against oracles that share nothing with them.

mod broad;
mod ccd_cases;
mod ccd_frames;
mod ccd_oracle;
mod ccd_queries;
mod contacts;
mod cull;
mod device;
mod device_split;
mod impact_zone;
mod impacts;
mod untangle;
