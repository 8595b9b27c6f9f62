//! Every kernel of `shaders/` on a real adapter against its f64 twin of `fathom_twins`.
//!
//! Kernel by stage, a twin is fed with what the kernels gave for the stage before, so that tolerances need to
//! cover one stage only. They come from the forward error bound of the formula at hand, with the constants of
//! `device.rs`; where blending has an edge (alpha of 1/255, the end of a ray, the cap), what lies within the
//! bound of it is counted. Runs on a CPU adapter too (lavapipe), about a minute on two cores: pictures are
//! small, but never a multiple of a tile.

#![expect(clippy::unwrap_used, reason = "a test may stop at what it did not expect")]

mod adam;
mod background;
mod bounds;
mod culling;
mod dbdr;
mod density;
mod device;
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
mod trainer;
mod view;
mod viewer_colours;
mod water;
mod workgroup_memory;
mod workload;
