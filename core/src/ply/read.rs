//! Reads splat PLY files of any program, row by row in bounded memory.
//!
//! The body may be text or binary of either byte order. Properties may have any order and any number type,
//! normals may be missing, and unknown properties are skipped. The number of `f_rest` properties gives the
//! degree. Rows are returned in the layout that [`super::SplatWriter`] writes, so a merge copies them
//! unchanged.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use super::Layout;
use super::header::{Element, Format, Header, Scalar};
use crate::gaussians::Gaussians;
use crate::gpu::Drawing;
use crate::surface::SurfaceRecord;
use crate::water::WaterRecord;
use crate::{CoreError, Result};

/// The command that converts other Gaussian formats to PLY.
const CONVERTER: &str = "npx @playcanvas/splat-transform";

/// A splat file that is being read.
pub struct SplatReader<R: Read> {
    source: R,
    name: String,
    layout: Layout,
    format: Format,
    comments: Vec<String>,
    count: u64,
    next: u64,
    /// First byte of the rows in the file.
    body_start: u64,
    /// For each property of the canonical row, its place in the file's row, or `None` for 0.
    columns: Vec<Option<Column>>,
    /// Numbers in a row of the file.
    numbers: usize,
    /// Whether a row of the file is a canonical row.
    canonical: bool,
    raw: Vec<u8>,
    row: Vec<u8>,
}

/// The place of a property in the file's row.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Column {
    /// Its index among the properties.
    place: usize,
    /// Its first byte in a binary row.
    start: usize,
    kind: Scalar,
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
    /// When it cannot be read, is not a splat PLY, or is shorter than its header says.
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
        let header = Header::read(&mut source).map_err(|message| match other_format(name) {
            Some(format) => refuse(format!(
                "is a .{format} file, but models must be PLY; convert it first: `{CONVERTER} IN.{format} OUT.ply`"
            )),
            None => refuse(message),
        })?;
        if header.elements.iter().any(|element| element.name == "chunk") {
            return Err(refuse(format!(
                "is a compressed PLY; convert it first: `{CONVERTER} IN.compressed.ply OUT.ply`"
            )));
        }
        let vertex = header.vertex_first().map_err(refuse)?;
        let layout = layout_of(vertex).map_err(refuse)?;
        let columns = columns_of(vertex, layout).map_err(refuse)?;
        let row_bytes = vertex.row_bytes();
        let canonical = header.format == Format::LittleEndian
            && row_bytes == layout.row_bytes()
            && columns.iter().enumerate().all(|(place, column)| {
                *column == Some(Column { place, start: 4 * place, kind: Scalar::F32 })
            });
        Ok(Self {
            source,
            name: name.to_owned(),
            layout,
            format: header.format,
            count: vertex.count,
            next: 0,
            body_start: header.bytes,
            columns,
            numbers: vertex.properties.len(),
            canonical,
            raw: vec![0; row_bytes],
            row: vec![0; layout.row_bytes()],
            comments: header.comments,
        })
    }

    /// First byte of the rows in a file as [`super::SplatWriter`] writes it; `None` for any other file.
    pub(super) fn rows_as_written_at(&self) -> Option<usize> {
        self.canonical.then_some(self.body_start as usize)
    }

    /// Number of Gaussians in the header.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Layout of the returned rows; its degree is that of the file.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// The comments of the header, without the word `comment`.
    pub fn comments(&self) -> &[String] {
        &self.comments
    }

    /// The next Gaussian; `None` after the last.
    ///
    /// # Errors
    /// When the file ends before the number of rows that its header says.
    pub fn next_row(&mut self) -> Result<Option<SplatRow<'_>>> {
        if self.next == self.count {
            return Ok(None);
        }
        let index = self.next;
        if self.format == Format::Ascii {
            self.read_line()?;
        } else {
            self.read_binary()?;
        }
        self.next += 1;
        let position = [0, 1, 2].map(|axis| float(&self.row, axis));
        Ok(Some(SplatRow { index, position, bytes: &self.row }))
    }

    /// Reads the next row of a binary body into `row`.
    fn read_binary(&mut self) -> Result<()> {
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
                    Some(Column { start, kind, .. }) => {
                        kind.read(&self.raw[*start..], self.format == Format::BigEndian) as f32
                    }
                    None => 0.0,
                };
                out.copy_from_slice(&value.to_le_bytes());
            }
        }
        Ok(())
    }

    /// Reads the next line of a text body into `row`.
    fn read_line(&mut self) -> Result<()> {
        // Far more than any number needs. Without a limit, a file of another kind could be one endless line.
        const MAX_NUMBER: usize = 64;
        let (index, count) = (self.next, self.count);
        let refuse = |message: String| {
            CoreError::input(
                &self.name,
                format!("Gaussian {index} of {count}: {message}; copy or export it again"),
            )
        };
        self.raw.clear();
        loop {
            let mut byte = [0];
            match self.source.read_exact(&mut byte) {
                Ok(()) if byte[0] == b'\n' => break,
                Ok(()) => self.raw.push(byte[0]),
                Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => break,
                Err(error) => return Err(CoreError::io("read", &self.name)(error)),
            }
            if self.raw.len() > MAX_NUMBER * self.numbers {
                return Err(refuse("its line is too long".to_owned()));
            }
        }
        let line = String::from_utf8_lossy(&self.raw);
        let mut values = Vec::with_capacity(self.numbers);
        for word in line.split_ascii_whitespace() {
            let value: f64 = word.parse().map_err(|_| refuse(format!("\"{word}\" is not a number")))?;
            values.push(value as f32);
        }
        if values.len() != self.numbers {
            return Err(refuse(format!("its line has {} numbers instead of {}", values.len(), self.numbers)));
        }
        for (column, out) in self.columns.iter().zip(self.row.chunks_exact_mut(4)) {
            let value = column.map_or(0.0, |column| values[column.place]);
            out.copy_from_slice(&value.to_le_bytes());
        }
        Ok(())
    }

    /// At most `max` of the next Gaussians; `None` after the last.
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
        if self.format == Format::Ascii {
            // Lines have any length; each is checked when it is read.
            return Ok(());
        }
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

/// How the Gaussians of a model were trained, from the comments [`super::ANTIALIASED`] and [`super::DISKS`]
/// in its header.
///
/// # Errors
/// As [`SplatReader::open`].
pub fn drawing(path: &Path) -> Result<Drawing> {
    let reader = SplatReader::open(path)?;
    let has = |comment: &str| reader.comments().iter().any(|known| known == comment);
    Ok(Drawing { mip_filter: has(super::ANTIALIASED), disks: has(super::DISKS) })
}

/// The water record in the header of a model; `None` for a model without a medium.
///
/// # Errors
/// As [`SplatReader::open`], and when the water record cannot be read.
pub fn water_record(path: &Path) -> Result<Option<WaterRecord>> {
    WaterRecord::among(SplatReader::open(path)?.comments())
}

/// Reads a whole model from memory; `name` is for messages.
///
/// # Errors
/// As [`SplatReader::open`].
pub fn from_bytes(bytes: &[u8], name: &str) -> Result<Gaussians> {
    SplatReader::from_bytes(bytes, name).and_then(read_all)
}

/// Of a scene with a water surface, the scene without it.
fn read_all<R: Read>(mut reader: SplatReader<R>) -> Result<Gaussians> {
    if SurfaceRecord::among(reader.comments())?.is_some() {
        let model = super::surface::read(reader)?;
        return model.map(|model| model.dry()).ok_or_else(|| CoreError::Scene("a model changed".into()));
    }
    let empty = Gaussians::empty(reader.layout.sh_degree());
    Ok(reader.next_block(usize::MAX)?.unwrap_or(empty))
}

pub(super) fn float(row: &[u8], index: usize) -> f32 {
    f32::from_le_bytes([row[index * 4], row[index * 4 + 1], row[index * 4 + 2], row[index * 4 + 3]])
}

pub(super) fn push_gaussian(gaussians: &mut Gaussians, layout: Layout, row: &[u8]) {
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

/// The other Gaussian format that a file's extension names.
fn other_format(name: &str) -> Option<&'static str> {
    let (_, ending) = name.rsplit_once('.')?;
    ["splat", "ksplat", "spz", "sog"].into_iter().find(|format| ending.eq_ignore_ascii_case(format))
}

/// The degree by the number of `f_rest` properties.
fn layout_of(vertex: &Element) -> Result<Layout, String> {
    let rest = vertex.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    (0..=3).filter_map(Layout::new).find(|layout| layout.rest_per_channel() * 3 == rest).ok_or_else(|| {
        format!("{rest} f_rest properties fit no SH degree (0, 9, 24 or 45: degree 0, 1, 2 or 3)")
    })
}

fn columns_of(vertex: &Element, layout: Layout) -> Result<Vec<Option<Column>>, String> {
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
                Some(place) => Ok(Some(Column {
                    place,
                    start: starts[place],
                    kind: vertex.properties[place].kind,
                })),
                None if matches!(name.as_str(), "nx" | "ny" | "nz") => Ok(None),
                None => Err(format!(
                    "the vertices have no property \"{name}\": this is not a Gaussian splat model, or a damaged one"
                )),
            }
        })
        .collect()
}
