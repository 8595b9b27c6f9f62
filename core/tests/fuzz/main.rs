//! Hostile input for every reader of this crate. `fathom_fuzz` explains how targets run, how long, and how to
//! replay a finding.
//!
//! A target reads its input as the program does, and accepted input must be sound. A panic is a finding. So
//! is a number that is not finite, or whose square is not finite.
#![expect(clippy::unwrap_used, reason = "a target fails by panicking")]

mod models;
mod pictures;
mod scenes;
mod texts;

#[global_allocator]
static ALLOCATOR: fathom_fuzz::Counting = fathom_fuzz::Counting;

/// Builds a sequence of little-endian bytes.
#[derive(Clone, Default)]
pub struct Bytes(pub Vec<u8>);

impl Bytes {
    fn u8s(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }
    fn u16(self, value: u16) -> Self {
        self.u8s(&value.to_le_bytes())
    }
    fn u32(self, value: u32) -> Self {
        self.u8s(&value.to_le_bytes())
    }
    fn u64(self, value: u64) -> Self {
        self.u8s(&value.to_le_bytes())
    }
    fn f64s(self, values: &[f64]) -> Self {
        values.iter().fold(self, |bytes, value| bytes.u8s(&value.to_le_bytes()))
    }
}
