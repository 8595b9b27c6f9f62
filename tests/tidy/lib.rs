//! Nothing: Cargo wants a library beside the test program `tidy`, which is what this package is for.
