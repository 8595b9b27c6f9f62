//! The rows of a binary PLY, one after the other, as bytes and as the position and opacity that they stand for.
//!
//! The merge moves Gaussians without looking into them, so nothing is decoded but x, y, z and opacity: whatever
//! a trainer writes besides survives, bit for bit.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use super::MergeError;

/// Longest header that is read; that of SH 3 has 1.5 kB.
const MAX_HEADER_BYTES: u64 = 64 * 1024;

/// What the header says about rows.
#[derive(Clone, Debug)]
pub struct Layout {
    /// Type and name of each property, in order.
    properties: Vec<(String, String)>,
    /// Bytes of a row.
    row_bytes: usize,
    /// Where x, y, z and opacity are in a row.
    offsets: [usize; 4],
    /// The header's lines without their ends.
    lines: Vec<String>,
}

impl Layout {
    /// Whether rows of both can stand in one file.
    pub fn same_rows(&self, other: &Self) -> bool {
        self.properties == other.properties
    }

    /// Comments of the header, without the word.
    pub fn comments(&self) -> Vec<String> {
        self.lines.iter().filter_map(|line| Some(line.strip_prefix("comment ")?.to_owned())).collect()
    }

    /// The same header with another number of rows.
    pub fn header(&self, rows: u64) -> Vec<u8> {
        let mut header = String::new();
        for line in &self.lines {
            if line.starts_with("element vertex ") {
                header.push_str(&format!("element vertex {rows}"));
            } else {
                header.push_str(line);
            }
            header.push('\n');
        }
        header.into_bytes()
    }

    /// A row in words, for errors.
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

/// A file that is open at its first row.
pub struct PlyRows {
    path: PathBuf,
    reader: BufReader<File>,
    layout: Layout,
    rows: u64,
    header_bytes: u64,
}

impl PlyRows {
    /// Reads the header.
    ///
    /// # Errors
    /// When the file cannot be read or is not a little-endian PLY whose only element has x, y, z and opacity.
    pub fn open(path: &Path) -> Result<Self, MergeError> {
        let file = File::open(path).map_err(MergeError::io("read", path))?;
        let mut reader = BufReader::with_capacity(1 << 20, file);
        let (layout, rows, header_bytes) = read_header(path, &mut reader)?;
        Ok(Self { path: path.to_owned(), reader, layout, rows, header_bytes })
    }

    /// What the header says about rows.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Calls `visit` with the position, the logit of the opacity and the bytes of every row; the file must end with the last one.
    ///
    /// # Errors
    /// When the file is cut short or longer than its header says, or `visit` fails.
    pub fn for_each(
        &mut self,
        mut visit: impl FnMut([f32; 3], f32, &[u8]) -> Result<(), MergeError>,
    ) -> Result<(), MergeError> {
        let mut row = vec![0; self.layout.row_bytes];
        for index in 0..self.rows {
            self.reader.read_exact(&mut row).map_err(|error| {
                if error.kind() != std::io::ErrorKind::UnexpectedEof {
                    return MergeError::io("read", &self.path)(error);
                }
                let offset = self.header_bytes + index * self.layout.row_bytes as u64;
                let rows = self.rows;
                let message = format!("ends in row {index} of {rows}, which starts at byte {offset}");
                MergeError::File { path: self.path.clone(), message }
            })?;
            let [x, y, z, logit] = self
                .layout
                .offsets
                .map(|at| f32::from_le_bytes([row[at], row[at + 1], row[at + 2], row[at + 3]]));
            visit([x, y, z], logit, &row)?;
        }
        let mut beyond = [0];
        match self.reader.read(&mut beyond).map_err(MergeError::io("read", &self.path))? {
            0 => Ok(()),
            _ => {
                let message = format!("has bytes after its last row (row {} of {0})", self.rows);
                Err(MergeError::File { path: self.path.clone(), message })
            }
        }
    }
}

/// Reads up to and with `end_header`; gives the layout, the number of rows and the header's length.
fn read_header(path: &Path, reader: &mut impl BufRead) -> Result<(Layout, u64, u64), MergeError> {
    let fault = |message: String| MergeError::File { path: path.to_owned(), message };
    let mut lines: Vec<String> = Vec::new();
    let mut header_bytes = 0;
    let mut limited = reader.take(MAX_HEADER_BYTES);
    while lines.last().is_none_or(|line| line != "end_header") {
        let mut line = Vec::new();
        let read = limited.read_until(b'\n', &mut line).map_err(MergeError::io("read", path))?;
        if line.pop() != Some(b'\n') {
            return Err(fault(format!("its PLY header has no end_header in {header_bytes} bytes")));
        }
        header_bytes += read as u64;
        let line = String::from_utf8(line).map_err(|_| fault("its PLY header is not text".to_owned()))?;
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
                let count: u64 = count.parse().map_err(|_| fault(format!("counts {count:?} vertices")))?;
                rows = Some(count);
            }
            ["property", kind, name] if rows.is_some() => {
                properties.push(((*kind).to_owned(), (*name).to_owned()));
            }
            _ => {
                let message =
                    format!("line {} of its PLY header is not that of Gaussians: {line:?}", number + 1);
                return Err(fault(message));
            }
        }
    }
    if !little_endian {
        return Err(fault("is not a binary_little_endian PLY".to_owned()));
    }
    let rows = rows.ok_or_else(|| fault("its PLY header has no vertices".to_owned()))?;
    let mut row_bytes = 0;
    let mut offsets = [None; 4];
    for (kind, name) in &properties {
        let size = match kind.as_str() {
            "char" | "uchar" | "int8" | "uint8" => 1,
            "short" | "ushort" | "int16" | "uint16" => 2,
            "int" | "uint" | "float" | "int32" | "uint32" | "float32" => 4,
            "double" | "float64" => 8,
            _ => return Err(fault(format!("property {name} has the unknown type {kind:?}"))),
        };
        if let Some(which) = ["x", "y", "z", "opacity"].iter().position(|known| known == name) {
            if !matches!(kind.as_str(), "float" | "float32") {
                return Err(fault(format!("property {name} is {kind}, not float")));
            }
            offsets[which] = Some(row_bytes);
        }
        row_bytes += size;
    }
    let [Some(x), Some(y), Some(z), Some(opacity)] = offsets else {
        return Err(fault("its vertices lack x, y, z or opacity".to_owned()));
    };
    let layout = Layout { properties, row_bytes, offsets: [x, y, z, opacity], lines };
    Ok((layout, rows, header_bytes))
}
