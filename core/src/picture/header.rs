//! Format, size and completeness of a picture file, from its header.
//!
//! Ingest checks thousands of photographs, so only the bytes before the pixels are read.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use super::tiff;
use crate::{CoreError, Result};

/// Formats that Fathom decodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    Png,
    Jpeg,
    Tiff,
}

impl Format {
    /// The format by the first bytes; the file name is ignored.
    pub fn of(start: &[u8]) -> Option<Self> {
        match start {
            [0x89, b'P', b'N', b'G', 0x0D, 0x0A, 0x1A, 0x0A, ..] => Some(Self::Png),
            [0xFF, 0xD8, 0xFF, ..] => Some(Self::Jpeg),
            [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => Some(Self::Tiff),
            _ => None,
        }
    }
}

pub(super) const UNKNOWN_FORMAT: &str =
    "is not a PNG, JPEG or TIFF file (by its first bytes); convert it to one of these";

/// Most pixels of a picture. The largest cameras have 150 million. At 16 bits and four channels, the most
/// pixels take 2 GiB, and as much again during decoding. A file of a few kB can declare any number.
pub(super) const MAX_PIXELS: u64 = 1 << 28;

/// Most scans of a JPEG. Progressive files have about ten, and each scan covers all pixels: a file of 1 MB
/// could hold so many that decoding takes hours. The limit is that of libjpeg-turbo's own tests.
const MAX_SCANS: usize = 500;

/// Columns and rows of a picture, from the header of its file.
///
/// # Errors
/// When the file cannot be read, has another format, ends inside its header, or declares too many pixels.
pub fn dimensions(path: &Path) -> Result<(u32, u32)> {
    let mut file = BufReader::new(File::open(path).map_err(CoreError::io("read", path))?);
    dimensions_of(&mut file).map_err(|message| CoreError::input(path, message))
}

/// As [`dimensions`], and checks that a JPEG has its end marker.
///
/// # Errors
/// As [`dimensions`], and when the JPEG is truncated.
pub fn dimensions_of_complete(path: &Path) -> Result<(u32, u32)> {
    let size = dimensions(path)?;
    let io = || CoreError::io("read", path);
    let mut file = File::open(path).map_err(io())?;
    let mut start = [0; 3];
    file.read_exact(&mut start).map_err(io())?;
    if Format::of(&start) != Some(Format::Jpeg) {
        return Ok(size);
    }
    // Nearly every complete file has its end marker near the end; otherwise the whole file is scanned.
    const TAIL: u64 = 4096;
    let len = file.metadata().map_err(io())?.len();
    file.seek(SeekFrom::Start(len.saturating_sub(TAIL))).map_err(io())?;
    let mut tail = Vec::new();
    file.read_to_end(&mut tail).map_err(io())?;
    if !tail.windows(2).any(|pair| pair == [0xFF, 0xD9]) {
        // Many pictures are checked at a time, and anybody may have made them.
        const MOST: u64 = 256 << 20;
        if len > MOST {
            let message = format!("the JPEG has {len} bytes and no end marker near its end; export it anew");
            return Err(CoreError::input(path, message));
        }
        let bytes = std::fs::read(path).map_err(io())?;
        check_jpeg_end(&bytes).map_err(|message| CoreError::input(path, message))?;
    }
    Ok(size)
}

/// Columns and rows; the error message does not name the file.
pub(super) fn dimensions_of<R: Read + Seek>(file: &mut R) -> Result<(u32, u32), String> {
    let unreadable = |error: std::io::Error| {
        if error.kind() == std::io::ErrorKind::UnexpectedEof {
            "the picture is truncated inside its header; copy it again".to_owned()
        } else {
            format!("the picture cannot be read: {error}")
        }
    };
    let mut start = Vec::new();
    file.by_ref().take(24).read_to_end(&mut start).map_err(unreadable)?;
    let size = match Format::of(&start) {
        None if start.is_empty() => Err("the file is empty; copy it again".to_owned()),
        None => Err(UNKNOWN_FORMAT.to_owned()),
        Some(Format::Png) => {
            let number =
                |at: usize| start.get(at..at + 4).and_then(|b| b.try_into().ok()).map(u32::from_be_bytes);
            match (start.get(12..16), number(16), number(20)) {
                (Some(b"IHDR"), Some(width), Some(height)) => Ok((width, height)),
                _ => Err("the PNG is truncated or damaged inside its header; copy it again".to_owned()),
            }
        }
        Some(Format::Jpeg) => {
            file.seek(SeekFrom::Start(2)).map_err(unreadable)?;
            jpeg_dimensions(file).map_err(unreadable)?.ok_or_else(|| {
                "the JPEG has pixels without a frame header: it is damaged; copy it again".to_owned()
            })
        }
        Some(Format::Tiff) => tiff::dimensions(file).map_err(unreadable)?,
    }?;
    if u64::from(size.0) * u64::from(size.1) > MAX_PIXELS {
        let (width, height) = size;
        return Err(format!(
            "the picture declares {width}x{height} pixels; the limit is {} million; reduce it, or cut it into several with \
             a camera each",
            MAX_PIXELS / 1_000_000
        ));
    }
    Ok(size)
}

/// Walks the segments of a JPEG to its frame header, starting after the first marker.
fn jpeg_dimensions<R: Read + Seek>(file: &mut R) -> std::io::Result<Option<(u32, u32)>> {
    let mut byte = [0; 1];
    loop {
        // A segment starts with one or more bytes 0xFF and the marker.
        file.read_exact(&mut byte)?;
        if byte[0] != 0xFF {
            return Ok(None);
        }
        while byte[0] == 0xFF {
            file.read_exact(&mut byte)?;
        }
        match byte[0] {
            0x01 | 0xD0..=0xD8 => {}
            0xD9 | 0xDA => return Ok(None),
            marker => {
                let mut length = [0; 2];
                file.read_exact(&mut length)?;
                let length = u16::from_be_bytes(length);
                if is_frame_header(marker) {
                    let mut frame = [0; 5];
                    file.read_exact(&mut frame)?;
                    let [_precision, h1, h0, w1, w0] = frame;
                    return Ok(Some((
                        u32::from(u16::from_be_bytes([w1, w0])),
                        u32::from(u16::from_be_bytes([h1, h0])),
                    )));
                }
                file.seek_relative(i64::from(length.max(2)) - 2)?;
            }
        }
    }
}

/// SOF0 to SOF15, without DHT, JPG and DAC, whose numbers lie among them.
fn is_frame_header(marker: u8) -> bool {
    matches!(marker, 0xC0..=0xCF) && !matches!(marker, 0xC4 | 0xC8 | 0xCC)
}

/// Walks a whole JPEG to its end marker and counts its scans. Decoders fill missing pixels with grey without
/// an error, and training would use that grey.
pub(super) fn check_jpeg_end(bytes: &[u8]) -> Result<(), String> {
    let truncated = || {
        format!(
            "the JPEG is truncated: it ends at byte {} without its end marker; copy it again or remove it",
            bytes.len()
        )
    };
    let (mut at, mut scans) = (2, 0);
    loop {
        // Finds the next marker. Inside the pixels, 0xFF00 is a stuffed byte and 0xFFD0..D7 are restarts.
        let start = bytes.get(at..).unwrap_or_default();
        let step = start
            .windows(2)
            .position(|pair| pair[0] == 0xFF && !matches!(pair[1], 0x00 | 0xFF | 0xD0..=0xD7))
            .ok_or_else(truncated)?;
        let marker = start[step + 1];
        at += step + 2;
        match marker {
            0xD9 => return Ok(()),
            0x01 | 0xD8 => {}
            _ => {
                scans += usize::from(marker == 0xDA);
                if scans > MAX_SCANS {
                    return Err(format!(
                        "the JPEG has more than {MAX_SCANS} scans, which no camera writes; export it anew"
                    ));
                }
                let length = bytes.get(at..at + 2).ok_or_else(truncated)?;
                at += usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
            }
        }
    }
}
