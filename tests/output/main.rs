//! Files: scenes and meshes read, frames, reports, traces and pictures written.

mod bodies;
mod caches;
mod compare;
mod files;
mod fuzz;
mod mesh_files;
mod one_obstacle;
mod outside_files;
mod person;
mod pictures;
mod records;
mod scene_any_input;
mod scene_arcsim;
mod scene_contact;
mod scene_far;
mod scene_files;
mod scene_maps;
mod scene_obstacles;
mod seams;
mod trace;
