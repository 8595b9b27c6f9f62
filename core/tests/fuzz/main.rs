//! Hostile input for every reader of this crate: `fathom_fuzz` says how it runs, how long, and how a finding
//! is replayed.
//!
//! A target reads as the program does, and what is taken must be sound: a number that is not finite, or so
//! large that its square is none, is a finding as a panic is.
#![expect(clippy::unwrap_used, reason = "a target fails by panicking")]

mod models;
mod pictures;
mod scenes;
mod texts;

#[global_allocator]
static ALLOCATOR: fathom_fuzz::Counting = fathom_fuzz::Counting;

/// Little-endian bytes in the making.
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
