#![expect(clippy::unwrap_used, reason = "a test may panic")]

mod colmap;
mod fixture;
mod json;
