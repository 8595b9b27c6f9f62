//! Reading splat PLY files of any program, row by row in bounded memory.
//!
//! The header decides: properties may stand in any order and be of any number type, normals may be missing, the
//! number of `f_rest` properties gives the degree, what Fathom does not know is skipped. Rows come out in the
//! order that [`super::SplatWriter`] writes, so a merge copies them as they are.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use super::Layout;
use super::header::{Element, Format, Header, Scalar};
use crate::gaussians::Gaussians;
use crate::{CoreError, Result};

/// A splat file that is being read.
pub struct SplatReader<R: Read> {
    source: R,
    name: String,
    layout: Layout,
    comments: Vec<String>,
    count: u64,
    next: u64,
    /// Where the rows start in the file.
    body_start: u64,
    /// One entry a property of the canonical row: where it stands in the file's row, or `None` for 0.
    columns: Vec<Option<(usize, Scalar)>>,
    /// Whether a row of the file is a canonical row.
    canonical: bool,
    raw: Vec<u8>,
    row: Vec<u8>,
}

/// One Gaussian as bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatRow<'a> {
    /// Its number in the file, from 0.
    pub index: u64,
    /// Its centre.
    pub position: [f32; 3],
    /// The row as [`super::SplatWriter::write_row`] takes it.
    pub bytes: &'a [u8],
}

impl SplatReader<BufReader<File>> {
    /// Opens a file.
    ///
    /// # Errors
    /// When it cannot be read, is no splat PLY, or is shorter than its header says.
    pub fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(CoreError::io("read", path))?;
        let len = file.metadata().map_err(CoreError::io("read", path))?.len();
        let reader = Self::new(BufReader::with_capacity(1 << 20, file), &path.display().to_string())?;
        reader.check_len(len)?;
        Ok(reader)
    }
}

impl<'a> SplatReader<&'a [u8]> {
    /// Reads from memory; `name` is for messages.
    ///
    /// # Errors
    /// As [`SplatReader::open`].
    pub fn from_bytes(bytes: &'a [u8], name: &str) -> Result<Self> {
        let reader = Self::new(bytes, name)?;
        reader.check_len(bytes.len() as u64)?;
        Ok(reader)
    }
}

impl<R: Read> SplatReader<R> {
    /// Reads the header. `name` is for messages.
    ///
    /// # Errors
    /// When the header is not that of a splat PLY.
    pub fn new(mut source: R, name: &str) -> Result<Self> {
        let refuse = |message: String| CoreError::input(name, message);
        let header = Header::read(&mut source).map_err(refuse)?;
        if header.elements.iter().any(|element| element.name == "chunk") {
            return Err(refuse(
                "is a compressed PLY; convert it first: `npx @playcanvas/splat-transform IN.compressed.ply OUT.ply`"
                    .to_owned(),
            ));
        }
        if header.format != Format::LittleEndian {
            return Err(refuse(
                "is not binary_little_endian, the one form that splat programs write; convert it first"
                    .to_owned(),
            ));
        }
        let vertex = header.vertex_first().map_err(refuse)?;
        let layout = layout_of(vertex).map_err(refuse)?;
        let columns = columns_of(vertex, layout).map_err(refuse)?;
        let row_bytes = vertex.row_bytes();
        let mut expected = 0;
        let canonical = row_bytes == layout.row_bytes()
            && columns.iter().all(|column| {
                let matches = *column == Some((expected, Scalar::F32));
                expected += 4;
                matches
            });
        Ok(Self {
            source,
            name: name.to_owned(),
            layout,
            count: vertex.count,
            next: 0,
            body_start: header.bytes,
            columns,
            canonical,
            raw: vec![0; row_bytes],
            row: vec![0; layout.row_bytes()],
            comments: header.comments,
        })
    }

    /// Number of Gaussians by the header.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Layout of the rows that come out; its degree is that of the file.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// The comments of the header, without the word `comment`.
    pub fn comments(&self) -> &[String] {
        &self.comments
    }

    /// The next Gaussian; `None` behind the last.
    ///
    /// # Errors
    /// When the file ends before the number of rows that its header says.
    pub fn next_row(&mut self) -> Result<Option<SplatRow<'_>>> {
        if self.next == self.count {
            return Ok(None);
        }
        let index = self.next;
        let target = if self.canonical { &mut self.row } else { &mut self.raw };
        match self.source.read_exact(target) {
            Ok(()) => {}
            Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
                let at = self.body_start + index * target.len() as u64;
                return Err(CoreError::input(
                    &self.name,
                    format!(
                        "byte {at}: the file is truncated inside Gaussian {index} of {}; copy it again",
                        self.count
                    ),
                ));
            }
            Err(error) => return Err(CoreError::io("read", &self.name)(error)),
        }
        if !self.canonical {
            for (column, out) in self.columns.iter().zip(self.row.chunks_exact_mut(4)) {
                let value = match column {
                    Some((at, kind)) => kind.read(&self.raw[*at..], false) as f32,
                    None => 0.0,
                };
                out.copy_from_slice(&value.to_le_bytes());
            }
        }
        self.next += 1;
        let position = [0, 1, 2].map(|axis| float(&self.row, axis));
        Ok(Some(SplatRow { index, position, bytes: &self.row }))
    }

    /// At most `max` of the next Gaussians; `None` behind the last.
    ///
    /// # Errors
    /// As [`SplatReader::next_row`].
    pub fn next_block(&mut self, max: usize) -> Result<Option<Gaussians>> {
        let layout = self.layout;
        let mut block = Gaussians::empty(layout.sh_degree());
        while block.len() < max {
            match self.next_row()? {
                Some(row) => push_gaussian(&mut block, layout, row.bytes),
                None => break,
            }
        }
        Ok(if block.is_empty() { None } else { Some(block) })
    }

    fn check_len(&self, len: u64) -> Result<()> {
        let row_bytes = self.raw.len() as u64;
        let fits = self
            .count
            .checked_mul(row_bytes)
            .and_then(|body| body.checked_add(self.body_start))
            .is_some_and(|needed| needed <= len);
        if fits {
            return Ok(());
        }
        let whole = len.saturating_sub(self.body_start) / row_bytes.max(1);
        Err(CoreError::input(
            &self.name,
            format!(
                "the header says {} Gaussians of {row_bytes} bytes, but the file ends at byte {len} inside \
                 Gaussian {whole}; copy it again",
                self.count
            ),
        ))
    }
}

/// Reads a whole model.
///
/// # Errors
/// As [`SplatReader::open`].
pub fn read_model(path: &Path) -> Result<Gaussians> {
    SplatReader::open(path).and_then(read_all)
}

/// Reads a whole model from memory; `name` is for messages.
///
/// # Errors
/// As [`SplatReader::open`].
pub fn from_bytes(bytes: &[u8], name: &str) -> Result<Gaussians> {
    SplatReader::from_bytes(bytes, name).and_then(read_all)
}

fn read_all<R: Read>(mut reader: SplatReader<R>) -> Result<Gaussians> {
    let empty = Gaussians::empty(reader.layout.sh_degree());
    Ok(reader.next_block(usize::MAX)?.unwrap_or(empty))
}

fn float(row: &[u8], index: usize) -> f32 {
    f32::from_le_bytes([row[index * 4], row[index * 4 + 1], row[index * 4 + 2], row[index * 4 + 3]])
}

fn push_gaussian(gaussians: &mut Gaussians, layout: Layout, row: &[u8]) {
    let at = |index: usize| float(row, index);
    let rest = layout.rest_per_channel();
    gaussians.means.push([at(0), at(1), at(2)]);
    gaussians.sh_coeffs.push([at(6), at(7), at(8)]);
    for k in 0..rest {
        gaussians.sh_coeffs.push([0, 1, 2].map(|channel| at(9 + channel * rest + k)));
    }
    let tail = 9 + 3 * rest;
    gaussians.opacity_logits.push(at(tail));
    gaussians.log_scales.push([at(tail + 1), at(tail + 2), at(tail + 3)]);
    gaussians.quats.push([at(tail + 4), at(tail + 5), at(tail + 6), at(tail + 7)]);
}

/// The degree by the number of `f_rest` properties.
fn layout_of(vertex: &Element) -> Result<Layout, String> {
    let rest = vertex.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    (0..=3).filter_map(Layout::new).find(|layout| layout.rest_per_channel() * 3 == rest).ok_or_else(|| {
        format!(
            "{rest} f_rest properties are of no SH degree that Fathom reads (0, 9, 24 or 45: degree 0, 1, 2 or 3)"
        )
    })
}

fn columns_of(vertex: &Element, layout: Layout) -> Result<Vec<Option<(usize, Scalar)>>, String> {
    let mut starts = Vec::with_capacity(vertex.properties.len());
    let mut at = 0;
    for property in &vertex.properties {
        starts.push(at);
        at += property.kind.bytes();
    }
    layout
        .names()
        .map(|name| {
            let found = vertex.properties.iter().position(|property| property.name == name);
            match found {
                Some(index) => Ok(Some((starts[index], vertex.properties[index].kind))),
                None if matches!(name.as_str(), "nx" | "ny" | "nz") => Ok(None),
                None => Err(format!(
                    "the vertices have no property \"{name}\": this is no Gaussian splat model, or a damaged one"
                )),
            }
        })
        .collect()
}
