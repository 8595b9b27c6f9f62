//! The crop merge.
