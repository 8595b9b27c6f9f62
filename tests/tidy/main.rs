//! The repository in order: what documents and sources must keep to, checked on the files themselves.
//!
//! This program links none of Fathom's packages, so it builds in a second.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod attack_table;
mod rules;
