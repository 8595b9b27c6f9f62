//! A scene with a water surface in one PLY.
//!
//! It has the layout of all models, so that a merge copies its rows as it copies any. The columns of normals,
//! which models leave 0, hold the set of a disk and the logit of its mask. A header comment says so: the
//! record of the surface. [`read_model`](super::read_model) takes such a file for the scene without the
//! surface.

use std::path::Path;

use super::{DISKS, SplatReader, to_bytes};
use crate::gaussians::Gaussians;
use crate::surface::{SurfaceModel, SurfaceRecord};
use crate::{CoreError, Result};

/// Columns of a row: the set of a disk (0 straight, 1 refracted, 2 reflected) and the logit of its mask.
const SET: usize = 3;
const MASK: usize = 4;

/// A model as bytes of a PLY. The sets follow each other, in their order.
///
/// # Errors
/// When the record or a comment cannot be written.
pub fn surface_to_bytes(model: &SurfaceModel, comments: &[String]) -> Result<Vec<u8>> {
    let mut all = Gaussians::empty(model.straight.sh_degree);
    let mut columns = Vec::new();
    for (set, disks) in [(0.0, &model.straight), (1.0, &model.refracted), (2.0, &model.reflected)] {
        for index in 0..disks.len() {
            all.push_from(disks, index);
            let mask = if set == 0.0 { model.masks.get(index).copied().unwrap_or(0.0) } else { 0.0 };
            columns.push([set, mask]);
        }
    }
    let mut comments = comments.to_vec();
    comments.push(DISKS.to_owned());
    comments.push(model.record.to_comment()?);
    let mut bytes = to_bytes(&all, &comments)?;
    let (start, row_bytes) = {
        let reader = SplatReader::from_bytes(&bytes, "model.ply")?;
        (reader.rows_as_written_at().unwrap_or(0), reader.layout().row_bytes())
    };
    for (row, columns) in bytes[start..].chunks_exact_mut(row_bytes).zip(columns) {
        for (column, value) in [SET, MASK].into_iter().zip(columns) {
            row[4 * column..][..4].copy_from_slice(&value.to_le_bytes());
        }
    }
    Ok(bytes)
}

/// Reads a scene with a water surface; `None` if the file is another model.
///
/// # Errors
/// As [`SplatReader::open`], and when the record cannot be read.
pub fn read_surface_model(path: &Path) -> Result<Option<SurfaceModel>> {
    read(SplatReader::open(path)?)
}

/// The same from memory; `name` is for messages.
///
/// # Errors
/// As [`read_surface_model`].
pub fn surface_from_bytes(bytes: &[u8], name: &str) -> Result<Option<SurfaceModel>> {
    read(SplatReader::from_bytes(bytes, name)?)
}

/// The same from a reader at its first row.
///
/// # Errors
/// As [`read_surface_model`].
pub fn surface_from_rows<R: std::io::Read>(reader: SplatReader<R>) -> Result<Option<SurfaceModel>> {
    read(reader)
}

/// Replaces disks of a model by those of `with`: disk `indices[set][k]` of set `set` by disk `k` of that set.
/// The sets are straight, reflected and refracted; indices ascend. `model` holds the bytes of
/// [`surface_to_bytes`] or a merge of such files. Masks stay.
///
/// # Errors
/// As [`replace_rows`](super::replace_rows).
pub fn replace_surface_rows(
    model: &mut [u8],
    name: &str,
    indices: [&[usize]; 3],
    with: [&Gaussians; 3],
) -> Result<()> {
    let mut reader = SplatReader::from_bytes(model, name)?;
    let mut rows: [Vec<usize>; 3] = Default::default();
    let mut columns: [Vec<[u8; 8]>; 3] = Default::default();
    let mut seen = [0; 3];
    while let Some(row) = reader.next_row()? {
        let set = match super::read::float(row.bytes, SET) {
            0.0 => 0,
            2.0 => 1,
            _ => 2,
        };
        if indices[set].get(rows[set].len()) == Some(&seen[set]) {
            rows[set].push(row.index as usize);
            columns[set].push(std::array::from_fn(|at| row.bytes[4 * SET + at]));
        }
        seen[set] += 1;
    }
    let (start, row_bytes) = (reader.rows_as_written_at(), reader.layout().row_bytes());
    for set in 0..3 {
        super::replace_rows(model, name, &rows[set], with[set])?;
        for (row, columns) in rows[set].iter().zip(&columns[set]) {
            model[start.unwrap_or(0) + row * row_bytes + 4 * SET..][..8].copy_from_slice(columns);
        }
    }
    Ok(())
}

pub(super) fn read<R: std::io::Read>(mut reader: SplatReader<R>) -> Result<Option<SurfaceModel>> {
    let Some(record) = SurfaceRecord::among(reader.comments())? else { return Ok(None) };
    let layout = reader.layout();
    let empty = || Gaussians::empty(layout.sh_degree());
    let mut model =
        SurfaceModel { straight: empty(), masks: Vec::new(), reflected: empty(), refracted: empty(), record };
    if reader.rows_as_written_at().is_none() {
        return Err(CoreError::Scene(
            "a model with a water surface must have the rows that this program writes".into(),
        ));
    }
    while let Some(row) = reader.next_row()? {
        let set = match super::read::float(row.bytes, SET) {
            0.0 => {
                model.masks.push(super::read::float(row.bytes, MASK));
                &mut model.straight
            }
            1.0 => &mut model.refracted,
            2.0 => &mut model.reflected,
            other => {
                let why = format!("row {} is of set {other}; there are 0, 1 and 2", row.index);
                return Err(CoreError::Scene(why));
            }
        };
        super::read::push_gaussian(set, layout, row.bytes);
    }
    Ok(Some(model))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Surface;
    use glam::DVec3;

    fn disks(count: usize, at: f32) -> Gaussians {
        let mut model = Gaussians::empty(1);
        for index in 0..count {
            let value = index as f32;
            model.means.push([at, value, -value]);
            model.quats.push([1.0, 0.0, 0.0, 0.0]);
            model.log_scales.push([-3.0, -2.0, -7.6]);
            model.opacity_logits.push(0.25 * value);
            model.sh_coeffs.extend([[value; 3]; 4]);
        }
        model
    }

    fn model() -> SurfaceModel {
        let surface = Surface { normal: DVec3::Y, offset: 0.5, ior: 1.333 };
        SurfaceModel {
            straight: disks(5, 0.0),
            masks: vec![-9.0, -1.0, 0.0, 1.0, 9.0],
            reflected: disks(3, 1.0),
            refracted: disks(2, 2.0),
            record: SurfaceRecord::given(&surface),
        }
    }

    #[test]
    fn a_scene_with_a_surface_is_read_back() {
        let bytes = surface_to_bytes(&model(), &["other".to_owned()]).unwrap();
        let read = surface_from_bytes(&bytes, "model").unwrap().unwrap();
        assert_eq!(read, model());
        let plain = to_bytes(&disks(3, 0.0), &[]).unwrap();
        assert!(surface_from_bytes(&plain, "model").unwrap().is_none());
    }

    #[test]
    fn other_readers_see_the_scene_without_the_surface() {
        let bytes = surface_to_bytes(&model(), &[]).unwrap();
        let dry = super::super::from_bytes(&bytes, "model").unwrap();
        assert_eq!(dry, model().dry());
        // The first straight disk is masked out, the reflected ones are no part of the scene, and the second
        // refracted one has left the water.
        assert_eq!(dry.len(), 4 + 1);
    }

    #[test]
    fn disks_of_sets_are_replaced_and_no_other_byte() {
        // As in a merge of partitions, sets are mixed.
        let written = surface_to_bytes(&model(), &[]).unwrap();
        let row_bytes = SplatReader::from_bytes(&written, "model").unwrap().layout().row_bytes();
        let (header, rows) = written.split_at(written.len() - 10 * row_bytes);
        let order = [8, 0, 5, 1, 2, 9, 6, 7, 3, 4].map(|row| &rows[row * row_bytes..][..row_bytes]);
        let mut merged = [header, &order.concat()].concat();
        let before = surface_from_bytes(&merged, "model").unwrap().unwrap();
        let with = [disks(2, 7.0), Gaussians::empty(1), disks(1, 9.0)];
        let indices: [&[usize]; 3] = [&[1, 4], &[], &[0]];
        replace_surface_rows(&mut merged, "model", indices, with.each_ref()).unwrap();
        let after = surface_from_bytes(&merged, "model").unwrap().unwrap();
        assert_eq!((&after.masks, &after.reflected), (&before.masks, &before.reflected));
        let straight = |model: &SurfaceModel, index: usize| model.straight.means[index];
        for index in 0..5 {
            let new = [1, 4].iter().position(|changed| *changed == index);
            let expected = new.map_or(straight(&before, index), |k| with[0].means[k]);
            assert_eq!(straight(&after, index), expected, "straight disk {index}");
        }
        assert_eq!(after.refracted.means, [with[2].means[0], before.refracted.means[1]]);
        let short = replace_surface_rows(&mut merged, "model", [&[0], &[], &[]], with.each_ref());
        assert!(short.unwrap_err().to_string().contains("cannot replace 1 rows"));
    }
}
