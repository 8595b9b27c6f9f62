//! Reads the records of the scripts and compares numbers with them.

use std::path::Path;

use serde::de::DeserializeOwned;

/// Allowed relative error. Both sides compute in f64. With 17 recorded digits, the worst error over all files
/// is 7e-12, of a gradient whose terms cancel. Recording 11 digits adds 5e-12.
const RELATIVE: f64 = 1e-10;
/// Numbers below this share of the largest of their kind get the tolerance of that share: a sum of large
/// terms that cancel has the rounding error of those terms.
const SMALL: f64 = 1e-3;

/// The content of `expectations/<name>.json`.
pub fn read<T: DeserializeOwned>(name: &str) -> T {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/expectations").join(format!("{name}.json"));
    let text = std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Fails unless every row of `ours` equals the row of `theirs` up to [`RELATIVE`].
#[track_caller]
pub fn assert_rows_close<const N: usize>(what: &str, ours: &[[f64; N]], theirs: &[[f64; N]]) {
    assert_eq!(ours.len(), theirs.len(), "{what}: rows");
    let largest = theirs.iter().flatten().fold(0.0, |most: f64, v| most.max(v.abs()));
    assert!(largest > 0.0, "{what}: only zeros are recorded, which proves nothing");
    for (row, (a, b)) in ours.iter().zip(theirs).enumerate() {
        for column in 0..N {
            let (a, b) = (a[column], b[column]);
            let tolerance = RELATIVE * b.abs().max(SMALL * largest);
            assert!(
                (a - b).abs() <= tolerance,
                "{what}, row {row}, column {column}: ours {a:e}, theirs {b:e}, tolerance {tolerance:e}"
            );
        }
    }
}

/// The same for one number per row.
#[track_caller]
pub fn assert_close(what: &str, ours: &[f64], theirs: &[f64]) {
    let rows = |values: &[f64]| -> Vec<[f64; 1]> { values.iter().map(|&v| [v]).collect() };
    assert_rows_close(what, &rows(ours), &rows(theirs));
}
