//! Writes splat PLY files in the property order of the reference implementation, which every program reads.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use super::Layout;
use crate::gaussians::Gaussians;
use crate::{CoreError, Result};

/// Writes rows one after the other. The number of rows is set at the start and checked at the end.
pub struct SplatWriter<W: Write> {
    sink: W,
    name: String,
    layout: Layout,
    announced: u64,
    written: u64,
    row: Vec<u8>,
}

impl<W: Write> SplatWriter<W> {
    /// Writes the header. `name` is for messages; each comment is one line.
    ///
    /// # Errors
    /// When the sink fails, the degree is above 3, or a comment has more than one line.
    pub fn new(mut sink: W, name: &str, count: u64, sh_degree: u8, comments: &[String]) -> Result<Self> {
        let layout = Layout::new(sh_degree).ok_or_else(|| {
            CoreError::input(name, format!("SH degree {sh_degree} cannot be written; 0 to 3 can"))
        })?;
        if let Some(comment) = comments.iter().find(|comment| comment.contains(['\n', '\r'])) {
            return Err(CoreError::input(name, format!("the comment {comment:?} is more than one line")));
        }
        let header = layout.header(count, comments);
        sink.write_all(header.as_bytes()).map_err(CoreError::io("write", name))?;
        let name = name.to_owned();
        Ok(Self {
            sink,
            name,
            layout,
            announced: count,
            written: 0,
            row: Vec::with_capacity(layout.row_bytes()),
        })
    }

    /// Appends Gaussians of the file's degree. Quaternions are normalised.
    ///
    /// # Errors
    /// When the sink fails or the degree differs.
    pub fn write(&mut self, gaussians: &Gaussians) -> Result<()> {
        if gaussians.sh_degree != self.layout.sh_degree() {
            return Err(CoreError::input(
                &self.name,
                format!(
                    "Gaussians of SH degree {} cannot go into a file of degree {}",
                    gaussians.sh_degree,
                    self.layout.sh_degree()
                ),
            ));
        }
        for index in 0..gaussians.len() {
            self.row.clear();
            push_row(&mut self.row, gaussians, index);
            self.sink.write_all(&self.row).map_err(CoreError::io("write", &self.name))?;
        }
        self.written += gaussians.len() as u64;
        Ok(())
    }

    /// Appends a row unchanged: [`Layout::row_bytes`] bytes, as [`super::SplatReader::next_row`] returns
    /// them.
    ///
    /// # Errors
    /// When the sink fails or the row has another length.
    pub fn write_row(&mut self, row: &[u8]) -> Result<()> {
        if row.len() != self.layout.row_bytes() {
            return Err(CoreError::input(
                &self.name,
                format!("a row of {} bytes; rows here have {}", row.len(), self.layout.row_bytes()),
            ));
        }
        self.sink.write_all(row).map_err(CoreError::io("write", &self.name))?;
        self.written += 1;
        Ok(())
    }

    /// Flushes and returns the sink.
    ///
    /// # Errors
    /// When the number of rows differs from the one in the header, or flushing fails.
    pub fn finish(mut self) -> Result<W> {
        if self.written != self.announced {
            return Err(CoreError::input(
                &self.name,
                format!("{} Gaussians were announced, {} written", self.announced, self.written),
            ));
        }
        self.sink.flush().map_err(CoreError::io("write", &self.name))?;
        Ok(self.sink)
    }
}

/// Appends one Gaussian as a row of [`Layout`]; its quaternion is normalised.
pub(super) fn push_row(row: &mut Vec<u8>, gaussians: &Gaussians, index: usize) {
    let coeffs = gaussians.coeffs();
    let sh = &gaussians.sh_coeffs[index * coeffs..(index + 1) * coeffs];
    let mut put =
        |values: &[f32]| values.iter().for_each(|value| row.extend_from_slice(&value.to_le_bytes()));
    put(&gaussians.means[index]);
    // Normals are unused, but old readers rely on the positions of the other properties.
    put(&[0.0; 3]);
    put(&sh[0]);
    // All of R, then all of G, then all of B.
    for channel in 0..3 {
        for coefficient in &sh[1..] {
            put(&coefficient[channel..=channel]);
        }
    }
    put(&[gaussians.opacity_logits[index]]);
    put(&gaussians.log_scales[index]);
    put(&normalised(gaussians.quats[index]));
}

/// The unit quaternion, computed in f64 so that the result is the nearest f32. A zero or non-finite
/// quaternion stays unchanged.
fn normalised(quat: [f32; 4]) -> [f32; 4] {
    let norm = quat.iter().map(|value| f64::from(*value).powi(2)).sum::<f64>().sqrt();
    let usable = norm > 0.0 && norm.is_finite();
    if usable { quat.map(|value| (f64::from(value) / norm) as f32) } else { quat }
}

/// A model as bytes of a PLY file.
///
/// # Errors
/// When the degree or a comment cannot be written.
pub fn to_bytes(gaussians: &Gaussians, comments: &[String]) -> Result<Vec<u8>> {
    let mut writer =
        SplatWriter::new(Vec::new(), "model.ply", gaussians.len() as u64, gaussians.sh_degree, comments)?;
    writer.write(gaussians)?;
    writer.finish()
}

/// Writes a model to a file atomically.
///
/// # Errors
/// When the file cannot be written.
pub fn write_model(path: &Path, gaussians: &Gaussians, comments: &[String]) -> Result<()> {
    write_whole(path, |file| {
        let name = path.display().to_string();
        let mut writer =
            SplatWriter::new(file, &name, gaussians.len() as u64, gaussians.sh_degree, comments)?;
        writer.write(gaussians)?;
        writer.finish().map(drop)
    })
}

/// Writes a file under a temporary name, syncs it and renames it, so that a crash leaves either the old file
/// or the new one.
///
/// # Errors
/// The error of `write`, or when the file cannot be created, synced or renamed. The temporary file is then
/// removed.
pub fn write_whole(path: &Path, write: impl FnOnce(&mut dyn Write) -> Result<()>) -> Result<()> {
    let mut temporary = path.as_os_str().to_owned();
    // The process id in the name keeps two writers apart.
    temporary.push(format!(".{}.tmp", std::process::id()));
    let temporary = Path::new(&temporary);
    let result = write_and_rename(path, temporary, write);
    if result.is_err() {
        // If this fails too, nothing more can be done; the first error is the one to report.
        let _ = std::fs::remove_file(temporary);
    }
    result
}

fn write_and_rename(
    path: &Path,
    temporary: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<()>,
) -> Result<()> {
    let file = File::create(temporary).map_err(CoreError::io("create", temporary))?;
    let mut sink = BufWriter::with_capacity(1 << 20, file);
    write(&mut sink)?;
    let file = sink.into_inner().map_err(|error| CoreError::io("write", temporary)(error.into_error()))?;
    file.sync_all().map_err(CoreError::io("sync", temporary))?;
    drop(file);
    std::fs::rename(temporary, path).map_err(CoreError::io("rename to", path))?;
    sync_folder(path)
}

/// Makes the rename durable. Windows keeps it in the journal and cannot open folders.
fn sync_folder(path: &Path) -> Result<()> {
    if cfg!(windows) {
        return Ok(());
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    File::open(folder).and_then(|folder| folder.sync_all()).map_err(CoreError::io("sync", folder))
}
