//! Rows as bytes: `[layout: u8][JSON][CRC-32C of both: u32, little endian]`.
//!
//! JSON keeps rows readable, and they are small: data that grows with a scene is in blobs. The database sled
//! checks its own pages. But it writes large values to separate files without syncing them, so such large
//! rows are refused here.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::StoreError;

/// The layout that this program writes and reads; the store records its layout as a whole
/// (`sled/written_by.rs`).
pub const LAYOUT: u8 = 2;

/// Largest row, bytes; see the rules in the module's comment.
const MAX_ROW_BYTES: usize = 64 << 10;

/// A row as bytes.
pub fn encode<T: Serialize>(tree: &'static str, row: &T) -> Result<Vec<u8>, StoreError> {
    encode_as(LAYOUT, tree, row)
}

/// A row as bytes, in a layout that may be another one: for migrations.
pub fn encode_as<T: Serialize>(layout: u8, tree: &'static str, row: &T) -> Result<Vec<u8>, StoreError> {
    let mut bytes = vec![layout];
    serde_json::to_writer(&mut bytes, row)
        .map_err(|e| StoreError::Unwritable { tree, message: e.to_string() })?;
    bytes.extend_from_slice(&crc32c::crc32c(&bytes).to_le_bytes());
    if bytes.len() > MAX_ROW_BYTES {
        return Err(StoreError::RowTooLarge { tree, bytes: bytes.len(), limit: MAX_ROW_BYTES });
    }
    Ok(bytes)
}

/// Decodes a row.
pub fn decode<T: DeserializeOwned>(tree: &'static str, bytes: &[u8]) -> Result<T, StoreError> {
    match layout_of(tree, bytes)? {
        (LAYOUT, json) => serde_json::from_slice(json)
            .map_err(|e| StoreError::Corrupt { tree, message: format!("a row cannot be read: {e}") }),
        (found, _) => Err(StoreError::OtherLayout { found, program: None, known: LAYOUT }),
    }
}

/// The layout of a row, and its JSON.
pub fn layout_of<'a>(tree: &'static str, bytes: &'a [u8]) -> Result<(u8, &'a [u8]), StoreError> {
    let corrupt = |message: String| StoreError::Corrupt { tree, message };
    let (body, checksum) =
        bytes.split_last_chunk::<4>().ok_or_else(|| corrupt(format!("a row of {} bytes", bytes.len())))?;
    if crc32c::crc32c(body) != u32::from_le_bytes(*checksum) {
        return Err(corrupt("a row has a wrong checksum".into()));
    }
    let (layout, json) = body.split_first().ok_or_else(|| corrupt("a row is empty".into()))?;
    Ok((*layout, json))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_reads_back_and_every_flipped_bit_is_noticed() {
        let row = ("partition-0001".to_owned(), 7_u64);
        let bytes = encode("test", &row).unwrap();
        assert_eq!(decode::<(String, u64)>("test", &bytes).unwrap(), row);
        for bit in 0..bytes.len() * 8 {
            let mut torn = bytes.clone();
            torn[bit / 8] ^= 1 << (bit % 8);
            assert!(decode::<(String, u64)>("test", &torn).is_err(), "bit {bit} flipped unnoticed");
        }
        for length in 0..bytes.len() {
            assert!(
                decode::<(String, u64)>("test", &bytes[..length]).is_err(),
                "{length} bytes read as a row"
            );
        }
    }

    #[test]
    fn a_row_that_is_too_large_is_refused_before_it_is_written() {
        let largest = "x".repeat(MAX_ROW_BYTES - 7);
        assert_eq!(encode("test", &largest).unwrap().len(), MAX_ROW_BYTES);
        let error = encode("test", &format!("{largest}x")).unwrap_err();
        assert!(
            matches!(error, StoreError::RowTooLarge { tree: "test", bytes, .. } if bytes == MAX_ROW_BYTES + 1),
            "{error}"
        );
    }

    #[test]
    fn a_row_of_another_layout_is_refused_but_not_as_damaged() {
        for (layout, which) in [(LAYOUT + 1, "a newer Fathom"), (LAYOUT - 1, "Fathom 0.1.0, which was never")]
        {
            let mut bytes = vec![layout, b'1'];
            bytes.extend_from_slice(&crc32c::crc32c(&bytes).to_le_bytes());
            let error = decode::<u64>("test", &bytes).unwrap_err();
            assert!(
                matches!(error, StoreError::OtherLayout { found, known: LAYOUT, .. } if found == layout),
                "{error}"
            );
            let said = error.to_string();
            assert!(said.contains(which) && !said.contains("is damaged"), "{said}");
        }
    }
}
