//! Every kernel in the shading languages that wgpu speaks, and the limits of WebGPU that kernels exceed. All
//! of it is tests; see `languages.rs`.

use fathom_core as _;
use naga as _;
