//! Compares every kernel of `shaders/` on a real adapter with its f64 twin in `fathom_twins`.
//!
//! Each twin gets the output of the kernels of the previous stage, so tolerances cover one stage only. They
//! come from the forward error bound of each formula. Blending has edges (alpha of 1/255, the end of a ray,
//! the cap); decisions within the bound of an edge are counted. The tests also run on a CPU adapter
//! (lavapipe), in about a minute on two cores. Pictures are small, but never a multiple of a tile.

#![expect(clippy::unwrap_used, reason = "a test may stop at what it did not expect")]

mod adam;
mod background;
mod bounds;
mod culling;
mod dbdr;
mod density;
mod device;
mod disk_training;
mod disks;
mod exposure;
mod film;
mod floaters;
mod handover;
mod hard_waters;
mod held_out;
mod intersect;
mod loss;
mod loss_factor;
mod overflow;
mod predictor;
mod priors;
mod project;
mod project_backward;
mod rasterize_backward;
mod rasterize_forward;
mod render;
mod scan;
mod shaders;
mod sort;
mod surface;
mod surface_backward;
mod surface_training;
mod trainer;
mod view;
mod viewer_colours;
mod water;
mod workgroup_memory;
mod workload;
