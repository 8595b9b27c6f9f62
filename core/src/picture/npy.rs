//! Writes NumPy's file of one array (format 1.0 of `numpy.lib.format`).

/// An f32 array [height, width] as the bytes of an `.npy` file for `numpy.load`: 128 bytes of header, then
/// little-endian f32, row-major. `values` has `width * height` entries.
pub fn encode_npy(width: u32, height: u32, values: &[f32]) -> Vec<u8> {
    debug_assert_eq!(values.len() as u64, u64::from(width) * u64::from(height));
    let fields = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
    // Magic, version 1.0 and the length of the rest of the header, which is padded so that the values begin
    // at a multiple of 64.
    let mut npy = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    npy.extend_from_slice(format!("{fields:<117}\n").as_bytes());
    npy.reserve(4 * values.len());
    values.iter().for_each(|value| npy.extend_from_slice(&value.to_le_bytes()));
    npy
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_array_is_a_header_of_128_bytes_and_its_numbers_row_by_row() {
        let npy = encode_npy(3, 2, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.5]);
        let header = b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }";
        assert!(npy.starts_with(header) && npy[127] == b'\n', "{:?}", String::from_utf8_lossy(&npy[..128]));
        assert!(npy[header.len()..127].iter().all(|byte| *byte == b' '));
        assert_eq!(npy.len(), 128 + 6 * 4);
        assert_eq!(npy[128 + 5 * 4..], 6.5_f32.to_le_bytes());
    }
}
