//! ply (being written).
