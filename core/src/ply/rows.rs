//! Replaces rows of a model; all other bytes stay as they are.

use super::read::SplatReader;
use super::write::push_row;
use crate::gaussians::Gaussians;
use crate::{CoreError, Result};

/// Replaces row `rows[k]` of `model` by Gaussian `k` of `with`. `model` holds the bytes of a PLY as
/// [`super::SplatWriter`] writes them; `name` is for messages. Quaternions are normalised.
///
/// # Errors
/// When `model` is not such a PLY or lacks a row, or when `with` has another degree or another number of
/// Gaussians than rows; `model` is then unchanged.
pub fn replace_rows(model: &mut [u8], name: &str, rows: &[usize], with: &Gaussians) -> Result<()> {
    let refuse = |message: String| Err(CoreError::input(name, message));
    let reader = SplatReader::from_bytes(model, name)?;
    let (layout, count) = (reader.layout(), reader.count());
    let Some(start) = reader.rows_as_written_at() else {
        return refuse("its rows do not have the layout that this program writes".into());
    };
    if layout.sh_degree() != with.sh_degree || rows.len() != with.len() {
        let (degree, rows, gaussians) = (layout.sh_degree(), rows.len(), with.len());
        return refuse(format!(
            "{gaussians} Gaussians of SH degree {} cannot replace {rows} rows of degree {degree}",
            with.sh_degree
        ));
    }
    if let Some(row) = rows.iter().find(|row| **row as u64 >= count) {
        return refuse(format!("there is no row {row}; it has {count}"));
    }
    let mut bytes = Vec::with_capacity(layout.row_bytes());
    for (index, row) in rows.iter().enumerate() {
        bytes.clear();
        push_row(&mut bytes, with, index);
        model[start + row * layout.row_bytes()..][..layout.row_bytes()].copy_from_slice(&bytes);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::{from_bytes, to_bytes};
    use super::*;

    fn model(count: usize, seed: f32) -> Gaussians {
        let mut model = Gaussians::empty(1);
        for index in 0..count {
            let value = seed + index as f32;
            model.means.push([value, -value, 0.5]);
            model.quats.push([1.0, 0.0, 0.0, 0.0]);
            model.log_scales.push([-value; 3]);
            model.opacity_logits.push(value);
            model.sh_coeffs.extend([[value; 3]; 4]);
        }
        model
    }

    #[test]
    fn the_named_rows_change_and_no_other_byte() {
        let comments = ["another comment".to_owned()];
        let before = to_bytes(&model(5, 1.0), &comments).unwrap();
        let mut after = before.clone();
        replace_rows(&mut after, "model", &[1, 4], &model(2, 50.0)).unwrap();
        let (was, with) = (model(5, 1.0), model(2, 50.0));
        let mut expected = Gaussians::empty(1);
        for (from, index) in [(&was, 0), (&with, 0), (&was, 2), (&was, 3), (&with, 1)] {
            expected.push_from(from, index);
        }
        assert_eq!(from_bytes(&after, "model").unwrap(), expected);
        assert_eq!(after, to_bytes(&expected, &comments).unwrap());

        replace_rows(&mut after, "model", &[1, 4], &was.split_where(|index| [1, 4].contains(&index)).0)
            .unwrap();
        assert_eq!(after, before, "the first rows are back");
    }

    #[test]
    fn unsuitable_rows_are_refused_and_change_nothing() {
        let before = to_bytes(&model(3, 1.0), &[]).unwrap();
        let mut bytes = before.clone();
        let other = Gaussians { sh_degree: 0, sh_coeffs: vec![[0.0; 3]], ..model(1, 9.0) };
        for (rows, with, fault) in [
            (&[0_usize, 3][..], &model(2, 9.0), "no row 3"),
            (&[0], &model(2, 9.0), "2 Gaussians"),
            (&[0], &other, "degree 0"),
        ] {
            let error = replace_rows(&mut bytes, "model", rows, with).unwrap_err().to_string();
            assert!(error.contains(fault), "{error}");
        }
        assert_eq!(bytes, before);
    }
}
