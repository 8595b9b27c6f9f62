//! The rows of a binary PLY as bytes, in blocks, and the few values of a row that the merge decodes.
//!
//! The merge copies rows as they are, and decodes little: centre and opacity, near borders also shape and
//! colour. All other properties that a trainer writes survive bit for bit.

use std::io::{BufRead, BufReader, Read, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::MergeError;
use crate::files::{Files, ReadSeek};

/// Rows of a block, which share one bound. The trainer culls in blocks of the same size (`CULL_CHUNK` of
/// `core::gpu`).
pub const BLOCK_ROWS: u64 = 4096;

/// Longest accepted header; that of SH 3 has 1.5 kB.
const MAX_HEADER_BYTES: u64 = 64 * 1024;

/// The row layout, from the header.
#[derive(Clone, Debug)]
pub struct Layout {
    /// Type and name of each property, in order.
    properties: Vec<(String, String)>,
    /// Bytes of a row.
    row_bytes: usize,
    /// Offsets of x, y, z and opacity in a row.
    offsets: [usize; 4],
    /// Offsets of shape and colour; `None` where one of their properties is missing.
    splat: Option<SplatOffsets>,
    /// The header's lines without their ends.
    lines: Vec<String>,
}

/// Offsets of shape and colour in a row.
#[derive(Clone, Copy, Debug)]
struct SplatOffsets {
    log_scales: [usize; 3],
    quat_wxyz: [usize; 4],
    colour: [usize; 3],
    set: Option<usize>,
}

/// Shape and colour of a row, as stored in the file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Splat {
    /// Logarithms of the standard deviations.
    pub log_scales: [f32; 3],
    /// Rotation, not normalised.
    pub quat_wxyz: [f32; 4],
    /// Coefficients of the constant harmonic.
    pub colour: [f32; 3],
    /// The set in a scene with a water surface, in the first column of normals; other models leave it 0.
    pub set: f32,
}

impl Layout {
    /// Whether rows of both can stand in one file.
    pub fn same_rows(&self, other: &Self) -> bool {
        self.properties == other.properties
    }

    /// Bytes of a row.
    pub fn row_bytes(&self) -> usize {
        self.row_bytes
    }

    /// Centre and logit of the opacity of a row.
    pub fn centre_and_logit(&self, row: &[u8]) -> ([f32; 3], f32) {
        let [x, y, z, logit] = self.offsets.map(|at| float(row, at));
        ([x, y, z], logit)
    }

    /// Logarithms of the standard deviations; `None` where rows have none.
    pub fn log_scales(&self, row: &[u8]) -> Option<[f32; 3]> {
        self.splat.map(|splat| splat.log_scales.map(|at| float(row, at)))
    }

    /// [`Splat::set`]; 0 where rows have none.
    pub fn set(&self, row: &[u8]) -> f32 {
        self.splat.and_then(|splat| splat.set).map_or(0.0, |at| float(row, at))
    }

    /// Shape and colour; `None` where rows have none.
    pub fn splat(&self, row: &[u8]) -> Option<Splat> {
        self.splat.map(|splat| Splat {
            log_scales: splat.log_scales.map(|at| float(row, at)),
            quat_wxyz: splat.quat_wxyz.map(|at| float(row, at)),
            colour: splat.colour.map(|at| float(row, at)),
            set: self.set(row),
        })
    }

    /// Comments of the header, without the word.
    pub fn comments(&self) -> Vec<String> {
        self.lines.iter().filter_map(|line| Some(line.strip_prefix("comment ")?.to_owned())).collect()
    }

    /// The same header with another number of rows.
    pub fn header(&self, rows: u64) -> Vec<u8> {
        let mut header = String::new();
        for line in &self.lines {
            // By words, as when it was read: any white space may separate them.
            let mut words = line.split_whitespace();
            if (words.next(), words.next()) == (Some("element"), Some("vertex")) {
                header.push_str(&format!("element vertex {rows}"));
            } else {
                header.push_str(line);
            }
            header.push('\n');
        }
        header.into_bytes()
    }

    /// The row layout, for error messages.
    pub fn describe(&self) -> String {
        let rest = self.properties.iter().filter(|(_, name)| name.starts_with("f_rest_")).count();
        let degree = match rest {
            0 => "SH 0".to_owned(),
            9 => "SH 1".to_owned(),
            24 => "SH 2".to_owned(),
            45 => "SH 3".to_owned(),
            other => format!("{other} f_rest values"),
        };
        format!("{degree}, {} properties, {} bytes a row", self.properties.len(), self.row_bytes)
    }
}

fn float(row: &[u8], at: usize) -> f32 {
    let bytes = &row[at..at + 4];
    f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
}

/// A file of Gaussians with a parsed header and a verified length.
#[derive(Clone, Debug)]
pub struct PlyFile {
    /// Where it is.
    pub files: Arc<dyn Files>,
    /// Its path.
    pub path: PathBuf,
    /// The row layout, from the header.
    pub layout: Layout,
    /// Number of rows.
    pub rows: u64,
    /// The header's bytes.
    pub header: Vec<u8>,
}

impl PlyFile {
    /// Reads the header.
    ///
    /// # Errors
    /// When the file cannot be read, is not a little-endian PLY whose only element has x, y, z and opacity,
    /// or its length does not match its header.
    pub fn read(files: &Arc<dyn Files>, path: &Path) -> Result<Self, MergeError> {
        let fault = |message: String| MergeError::File { path: path.to_owned(), message };
        let (file, bytes) = files.open(path).map_err(MergeError::io("read", path))?;
        let (layout, rows, header) = read_header(path, &mut BufReader::new(file))?;
        if rows > u64::from(u32::MAX) {
            return Err(fault(format!("has {rows} Gaussians; a partition has at most {}", u32::MAX)));
        }
        let (row_bytes, header_bytes) = (layout.row_bytes as u64, header.len() as u64);
        let whole = header_bytes + rows * row_bytes;
        if bytes < whole {
            let index = (bytes - header_bytes) / row_bytes;
            let offset = header_bytes + index * row_bytes;
            return Err(fault(format!("ends in row {index} of {rows}, which starts at byte {offset}")));
        }
        if bytes > whole {
            return Err(fault(format!("has bytes after its last row (row {rows} of {rows})")));
        }
        Ok(Self { files: Arc::clone(files), path: path.to_owned(), layout, rows, header })
    }

    /// Number of blocks: all but the last have [`BLOCK_ROWS`] rows.
    pub fn blocks(&self) -> u64 {
        self.rows.div_ceil(BLOCK_ROWS)
    }

    /// Rows of a block.
    pub fn rows_of(&self, block: u64) -> u64 {
        self.rows.saturating_sub(block * BLOCK_ROWS).min(BLOCK_ROWS)
    }

    /// Bytes of a block.
    pub fn block_bytes(&self, block: u64) -> usize {
        self.rows_of(block) as usize * self.layout.row_bytes
    }

    /// Bytes of the largest block.
    pub fn largest_block_bytes(&self) -> usize {
        BLOCK_ROWS.min(self.rows) as usize * self.layout.row_bytes
    }

    /// Opens the rows.
    ///
    /// # Errors
    /// When the file can no longer be read.
    pub fn open(&self) -> Result<Blocks<'_>, MergeError> {
        let (file, _) = self.files.open(&self.path).map_err(MergeError::io("read", &self.path))?;
        Ok(Blocks { of: self, file, at: None })
    }
}

/// An open file, to read blocks.
pub struct Blocks<'a> {
    of: &'a PlyFile,
    file: Box<dyn ReadSeek>,
    /// The next block without seeking.
    at: Option<u64>,
}

impl Blocks<'_> {
    /// Reads a block into `buffer` of [`PlyFile::block_bytes`].
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn read(&mut self, block: u64, buffer: &mut [u8]) -> Result<(), MergeError> {
        let failed = MergeError::io("read", &self.of.path);
        if self.at != Some(block) {
            let rows_before = block * BLOCK_ROWS * self.of.layout.row_bytes as u64;
            let offset = self.of.header.len() as u64 + rows_before;
            if let Err(error) = self.file.seek(SeekFrom::Start(offset)) {
                return Err(failed(error));
            }
        }
        self.at = Some(block + 1);
        self.file.read_exact(buffer).map_err(failed)
    }
}

/// Reads up to and including `end_header`; returns the layout, the number of rows and the header's bytes.
fn read_header(path: &Path, reader: &mut impl BufRead) -> Result<(Layout, u64, Vec<u8>), MergeError> {
    let fault = |message: String| MergeError::File { path: path.to_owned(), message };
    let mut lines: Vec<String> = Vec::new();
    let mut header = Vec::new();
    let mut limited = reader.take(MAX_HEADER_BYTES);
    while lines.last().is_none_or(|line| line != "end_header") {
        let start = header.len();
        limited.read_until(b'\n', &mut header).map_err(MergeError::io("read", path))?;
        let Some(line) = header[start..].strip_suffix(b"\n") else {
            return Err(fault(format!("its PLY header has no end_header in {start} bytes")));
        };
        let line = str::from_utf8(line).map_err(|_| fault("its PLY header is not text".to_owned()))?;
        lines.push(line.trim_end_matches('\r').to_owned());
        if lines[0] != "ply" {
            return Err(fault("is not a PLY file (it does not start with \"ply\")".to_owned()));
        }
    }

    let mut rows = None;
    let mut little_endian = false;
    let mut properties: Vec<(String, String)> = Vec::new();
    for (number, line) in lines.iter().enumerate() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["ply" | "end_header"] | ["comment" | "obj_info", ..] => {}
            ["format", "binary_little_endian", "1.0"] => little_endian = true,
            ["element", "vertex", count] if rows.is_none() => {
                let count: u64 =
                    count.parse().map_err(|_| fault(format!("has the invalid vertex count {count:?}")))?;
                rows = Some(count);
            }
            ["property", kind, name] if rows.is_some() => {
                properties.push(((*kind).to_owned(), (*name).to_owned()));
            }
            _ => {
                let message =
                    format!("line {} of its PLY header is not from a PLY of Gaussians: {line:?}", number + 1);
                return Err(fault(message));
            }
        }
    }
    if !little_endian {
        return Err(fault("is not a binary_little_endian PLY".to_owned()));
    }
    let rows = rows.ok_or_else(|| fault("its PLY header has no vertices".to_owned()))?;
    let mut row_bytes = 0;
    let mut floats: Vec<(&str, usize)> = Vec::new();
    for (kind, name) in &properties {
        let size = match kind.as_str() {
            "char" | "uchar" | "int8" | "uint8" => 1,
            "short" | "ushort" | "int16" | "uint16" => 2,
            "int" | "uint" | "float" | "int32" | "uint32" | "float32" => 4,
            "double" | "float64" => 8,
            _ => return Err(fault(format!("property {name} has the unknown type {kind:?}"))),
        };
        if matches!(kind.as_str(), "float" | "float32") {
            floats.push((name, row_bytes));
        } else if ["x", "y", "z", "opacity"].contains(&name.as_str()) {
            return Err(fault(format!("property {name} is {kind}, not float")));
        }
        row_bytes += size;
    }
    let offset = |name: &str| floats.iter().rfind(|(known, _)| *known == name).map(|(_, at)| *at);
    let [Some(x), Some(y), Some(z), Some(opacity)] = ["x", "y", "z", "opacity"].map(offset) else {
        return Err(fault("its vertices lack x, y, z or opacity".to_owned()));
    };
    let splat = (|| {
        let three = |stem: &str| {
            Some([offset(&format!("{stem}0"))?, offset(&format!("{stem}1"))?, offset(&format!("{stem}2"))?])
        };
        let [w, x, y] = three("rot_")?;
        Some(SplatOffsets {
            log_scales: three("scale_")?,
            quat_wxyz: [w, x, y, offset("rot_3")?],
            colour: three("f_dc_")?,
            set: offset("nx"),
        })
    })();
    let layout = Layout { row_bytes, offsets: [x, y, z, opacity], splat, lines, properties };
    Ok((layout, rows, header))
}
