//! picture (being written).
