//! Reads sparse points from a PLY file of any program: ASCII or binary, positions of any number type, colours
//! if present.

use std::path::Path;

use super::Points;
use crate::ply::header::{Format, Header, Scalar};
use crate::{CoreError, Result};

/// The points, and the number of those that [`Points::push`] refuses.
pub(super) fn read(path: &Path) -> Result<(Points, usize)> {
    let bytes = std::fs::read(path).map_err(CoreError::io("read", path))?;
    let refuse = |message: String| CoreError::input(path, message);
    let mut rest = bytes.as_slice();
    let header = Header::read(&mut rest).map_err(refuse)?;
    let vertex = header.vertex_first().map_err(refuse)?;
    let column = |name: &str| vertex.properties.iter().position(|property| property.name == name);
    let (Some(x), Some(y), Some(z)) = (column("x"), column("y"), column("z")) else {
        return Err(refuse("the vertices have no x, y and z".to_owned()));
    };
    let colours = match (column("red"), column("green"), column("blue")) {
        (Some(red), Some(green), Some(blue)) => Some([red, green, blue]),
        _ => None,
    };
    let kinds: Vec<Scalar> = vertex.properties.iter().map(|property| property.kind).collect();
    let row_bytes = kinds.iter().map(|kind| kind.bytes()).sum::<usize>().max(1);
    if header.format != Format::Ascii && vertex.count.saturating_mul(row_bytes as u64) > rest.len() as u64 {
        return Err(refuse(format!(
            "the header says {} vertices of {row_bytes} bytes, but only {} bytes follow; the file is truncated",
            vertex.count,
            rest.len()
        )));
    }

    let (mut points, mut not_finite) = (Points::default(), 0);
    let mut text = rest.split(|byte| *byte == b'\n');
    let mut rows = rest.chunks_exact(row_bytes);
    let mut row = vec![0.0; kinds.len()];
    for index in 0..vertex.count {
        let read = match header.format {
            Format::Ascii => text.next().is_some_and(|line| read_ascii(line, &mut row)),
            format => rows.next().map(|bytes| read_binary(bytes, &kinds, format, &mut row)).is_some(),
        };
        if !read {
            return Err(refuse(format!(
                "vertex {index} of {} is missing or has too few numbers; the file is truncated",
                vertex.count
            )));
        }
        let colour = colours.map_or([127; 3], |columns| {
            columns.map(|column| match kinds[column] {
                // Programs that write floats use 0..1.
                Scalar::F32 | Scalar::F64 => (row[column] * 255.0).round() as u8,
                Scalar::U16 => (row[column] / 257.0).round() as u8,
                _ => row[column] as u8,
            })
        });
        if !points.push([row[x], row[y], row[z]], colour) {
            not_finite += 1;
        }
    }
    Ok((points, not_finite))
}

fn read_ascii(line: &[u8], row: &mut [f64]) -> bool {
    let Ok(line) = std::str::from_utf8(line) else { return false };
    let mut words = line.split_ascii_whitespace();
    row.iter_mut().all(|value| match words.next().map(str::parse) {
        Some(Ok(parsed)) => {
            *value = parsed;
            true
        }
        _ => false,
    })
}

fn read_binary(mut bytes: &[u8], kinds: &[Scalar], format: Format, row: &mut [f64]) {
    for (value, kind) in row.iter_mut().zip(kinds) {
        let (head, tail) = bytes.split_at(kind.bytes());
        *value = kind.read(head, format == Format::BigEndian);
        bytes = tail;
    }
}
