//! The first directory of a TIFF (TIFF 6.0, section 2; BigTIFF): the size of the picture, and a check of the
//! counts.
//!
//! A decoder allocates as many values as an entry declares before it reads them. A count that exceeds the
//! file is refused here, so that a few bytes cannot make a decoder allocate hundreds of MB.

use std::io::{Read, Seek, SeekFrom};

/// Most entries of a directory; cameras write a few dozen.
const MAX_ENTRIES: u64 = 4096;

const IMAGE_WIDTH: u16 = 256;
const IMAGE_LENGTH: u16 = 257;

/// Numbers of a file in the order of its bytes.
struct Numbers<'a, R> {
    file: &'a mut R,
    big_endian: bool,
}

impl<R: Read> Numbers<'_, R> {
    /// The next number of `N` bytes, at most eight.
    fn next<const N: usize>(&mut self) -> std::io::Result<u64> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes)?;
        if self.big_endian {
            bytes.reverse();
        }
        Ok(bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte)))
    }
}

/// Columns and rows of the first picture; a message if they are missing or an entry declares more values than
/// the file could hold.
pub(super) fn dimensions<R: Read + Seek>(file: &mut R) -> std::io::Result<Result<(u32, u32), String>> {
    let damaged =
        |what: String| Ok(Err(format!("the TIFF is damaged: {what}; copy it again or export it anew")));
    let len = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(0))?;
    let mut order = [0; 2];
    file.read_exact(&mut order)?;
    let mut numbers = Numbers { file, big_endian: order == *b"MM" };
    let is_big = numbers.next::<2>()? == 43;
    let start = if is_big {
        // The size of an offset, always eight, and two bytes of zero.
        numbers.next::<4>()?;
        numbers.next::<8>()?
    } else {
        numbers.next::<4>()?
    };
    numbers.file.seek(SeekFrom::Start(start))?;
    let entries = if is_big { numbers.next::<8>()? } else { numbers.next::<2>()? };
    if entries > MAX_ENTRIES {
        return damaged(format!("its directory declares {entries} entries; the limit is {MAX_ENTRIES}"));
    }
    let (mut width, mut height) = (None, None);
    for _ in 0..entries {
        let (tag, kind) = (numbers.next::<2>()? as u16, numbers.next::<2>()?);
        let count = if is_big { numbers.next::<8>()? } else { numbers.next::<4>()? };
        let value_bytes = match kind {
            3 | 8 => 2,
            4 | 9 | 11 | 13 => 4,
            5 | 10 | 12 | 16..=18 => 8,
            _ => 1,
        };
        if count.checked_mul(value_bytes).is_none_or(|bytes| bytes > len) {
            return damaged(format!(
                "entry {tag} of its directory declares {count} values of {value_bytes} bytes, but the file has {len} bytes"
            ));
        }
        // A number is at the start of the field; the rest of the field is unused.
        let field = numbers.file.stream_position()?;
        let number = match kind {
            3 => numbers.next::<2>()?,
            4 => numbers.next::<4>()?,
            16 if is_big => numbers.next::<8>()?,
            _ => 0,
        };
        numbers.file.seek(SeekFrom::Start(field + if is_big { 8 } else { 4 }))?;
        match tag {
            IMAGE_WIDTH => width = Some(number),
            IMAGE_LENGTH => height = Some(number),
            _ => {}
        }
    }
    let side = |number: Option<u64>| number.and_then(|n| u32::try_from(n).ok()).filter(|&n| n > 0);
    match (side(width), side(height)) {
        (Some(width), Some(height)) => Ok(Ok((width, height))),
        _ => damaged("its directory does not give the width and height of the picture".to_owned()),
    }
}
