//! Gaussian models as PLY files, in the layout that splat programs read.
//!
//! The format is `binary_little_endian`, all `float`, in the order of the reference implementation: `x y z nx
//! ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3`. `f_rest` goes channel by channel (all of R, then
//! G, then B). Opacity is a logit, scales are logarithms, rotation is w x y z. Values are written exactly as
//! trained, except that quaternions are normalised.

mod compressed;
pub(crate) mod header;
mod read;
mod rows;
mod surface;
mod write;

use std::fmt::Write as _;

pub use compressed::{CompressedCopy, compressed};
pub use read::{SplatReader, SplatRow, drawing, from_bytes, read_model, water_record};
/// Header comment of a model that was trained with the 2D filter of Mip-Splatting and must be rendered with
/// it.
pub const ANTIALIASED: &str = "antialiased: opacity makes up for a low-pass of 0.3 px^2";

/// Header comment of a model of 2D Gaussians. Programs that know only 3D Gaussians show them as thin ones.
pub const DISKS: &str = "disks: 2D Gaussians, whose third scale is not rendered";

pub use rows::replace_rows;
pub use surface::{
    read_surface_model, replace_surface_rows, surface_from_bytes, surface_from_rows, surface_to_bytes,
};
pub use write::{SplatWriter, to_bytes, write_model, write_whole};

/// The properties of a row for a degree of the spherical harmonics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    sh_degree: u8,
}

impl Layout {
    /// The layout of a degree, 0 to 3.
    pub fn new(sh_degree: u8) -> Option<Self> {
        (sh_degree <= 3).then_some(Self { sh_degree })
    }

    /// Degree of the spherical harmonics.
    pub fn sh_degree(self) -> u8 {
        self.sh_degree
    }

    /// Coefficients of a channel without the constant one.
    pub fn rest_per_channel(self) -> usize {
        (usize::from(self.sh_degree) + 1).pow(2) - 1
    }

    /// Bytes of a Gaussian.
    pub fn row_bytes(self) -> usize {
        4 * (17 + 3 * self.rest_per_channel())
    }

    /// The header of a file of `count` Gaussians.
    pub fn header(self, count: u64, comments: &[String]) -> String {
        let mut header = "ply\nformat binary_little_endian 1.0\n".to_owned();
        let mut line = |text: std::fmt::Arguments<'_>| {
            // Writing into a string cannot fail.
            let _ = header.write_fmt(text);
        };
        for comment in comments {
            line(format_args!("comment {comment}\n"));
        }
        line(format_args!("element vertex {count}\n"));
        for name in self.names() {
            line(format_args!("property float {name}\n"));
        }
        line(format_args!("end_header\n"));
        header
    }

    /// Names of the properties, in the order of a row.
    fn names(self) -> impl Iterator<Item = String> {
        let words = |names: &'static str| names.split(' ').map(str::to_owned);
        words("x y z nx ny nz f_dc_0 f_dc_1 f_dc_2")
            .chain((0..3 * self.rest_per_channel()).map(|index| format!("f_rest_{index}")))
            .chain(words("opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"))
    }
}

#[cfg(test)]
mod tests;
