//! Twins (being written).
