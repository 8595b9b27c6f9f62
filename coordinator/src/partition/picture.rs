//! plan.png.
