//! Maps of a render besides its colours: range, alpha and normals, one folder each.
//!
//! `.npy` files hold the exact ranges. The range PNGs are for viewing and share one scale over all pictures,
//! so that a camera path does not flicker. The scale is known only after all pictures are rendered, so the
//! PNGs are written last.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use fathom_core::gpu::{Rendered, SurfaceOutput};
use fathom_core::picture;
use serde_json::{Value, json};

use crate::error::{CliError, Result};

/// Maps written beside the colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub enum Map {
    /// Expected distance along the ray, scene units: `.npy` (f32 [height, width], 0 for nothing) and a PNG
    /// for viewing. In the PNG, white is near and black is nothing; scale.json maps grey to range
    Range,
    /// Coverage by Gaussians, 0 to 1: PNG, 8 bits
    Alpha,
    /// Shortest axes of the Gaussians, facing the camera: PNG, (n + 1) / 2 as RGB, in the camera's frame (x
    /// right, y down, z forward), 128 grey where there is nothing
    Normal,
    /// Method wsgs: what the water surface reflects, at full strength: PNG
    Reflected,
    /// Method wsgs: what lies in the water, as the surface refracts it: PNG
    Refracted,
    /// Method wsgs: the share of the light that the surface reflects, 0 to 1: PNG, 8 bits
    Fresnel,
    /// Method wsgs: where the scene above water is seen, 0 to 1: PNG, 8 bits
    Mask,
}

/// Share of the nearest and of the farthest pixels that the scale of the range PNGs excludes.
const EXCLUDED_SHARE: f64 = 0.01;
/// Pixels sampled from each picture for the scale.
const SAMPLES_PER_PICTURE: usize = 1024;
/// Header bytes in a file of `picture::encode_npy`.
const NPY_HEADER: usize = 128;

impl Map {
    /// Name of its folder.
    pub fn folder(self) -> &'static str {
        match self {
            Self::Range => "range",
            Self::Alpha => "alpha",
            Self::Normal => "normal",
            Self::Reflected => "reflected",
            Self::Refracted => "refracted",
            Self::Fresnel => "fresnel",
            Self::Mask => "mask",
        }
    }

    /// What it shows of a scene with a water surface; `None` for maps of every model.
    pub fn of_surface(self) -> Option<SurfaceOutput> {
        match self {
            Self::Range | Self::Alpha | Self::Normal => None,
            Self::Reflected => Some(SurfaceOutput::Reflected),
            Self::Refracted => Some(SurfaceOutput::Refracted),
            Self::Fresnel => Some(SurfaceOutput::Reflectance),
            Self::Mask => Some(SurfaceOutput::Mask),
        }
    }
}

/// Writes the maps into subfolders of the folder of the pictures.
pub struct MapWriter {
    folder: PathBuf,
    maps: Vec<Map>,
    /// Sampled ranges of every picture, scene units.
    votes: Vec<f32>,
    files: Vec<(Map, PathBuf)>,
    ranges: Vec<RangeFile>,
}

struct RangeFile {
    npy: PathBuf,
    width: u32,
    height: u32,
}

/// Mapping from range to grey in the PNGs.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Scale {
    /// Range shown as grey 255, scene units.
    near: f32,
    /// Range shown as grey 1, scene units.
    far: f32,
}

impl MapWriter {
    /// Creates the folders.
    pub fn new(folder: &Path, maps: &[Map]) -> Result<Self> {
        let mut maps = maps.to_vec();
        maps.sort_unstable();
        maps.dedup();
        for map in &maps {
            let folder = folder.join(map.folder());
            std::fs::create_dir_all(&folder).map_err(CliError::io("create", &folder))?;
        }
        Ok(Self { folder: folder.to_owned(), maps, votes: Vec::new(), files: Vec::new(), ranges: Vec::new() })
    }

    /// Whether `map` was requested.
    pub fn wants(&self, map: Map) -> bool {
        self.maps.contains(&map)
    }

    /// Writes the maps of one picture with the file name `picture` (`a.png`). `normals` `[H*W]` is required
    /// if normals were requested.
    pub fn write(&mut self, picture: &str, rendered: &Rendered, normals: Option<&[[f32; 3]]>) -> Result<()> {
        let (width, height) = (rendered.width, rendered.height);
        if self.wants(Map::Range) {
            let range = rendered.expected_range();
            self.vote(&range, &rendered.alpha);
            let npy = Path::new(picture).with_extension("npy");
            let npy = self.put(Map::Range, &npy, &picture::encode_npy(width, height, &range))?;
            self.ranges.push(RangeFile { npy, width, height });
        }
        if self.wants(Map::Alpha) {
            let grey: Vec<u8> = rendered.alpha.iter().map(|alpha| code(*alpha)).collect();
            self.put(Map::Alpha, Path::new(picture), &picture::encode_grey_png(width, height, &grey)?)?;
        }
        if let Some(normals) = normals.filter(|_| self.wants(Map::Normal)) {
            let rgb: Vec<u8> =
                normals.iter().flatten().map(|component| code((component + 1.0) / 2.0)).collect();
            self.put(Map::Normal, Path::new(picture), &picture::encode_png(width, height, &rgb)?)?;
        }
        Ok(())
    }

    /// Writes the maps that only a scene with a water surface has. `render` gives each of them.
    pub fn write_of_surface(
        &mut self,
        picture: &str,
        mut render: impl FnMut(SurfaceOutput) -> Result<Rendered>,
    ) -> Result<()> {
        for map in self.maps.clone() {
            let Some(output) = map.of_surface() else { continue };
            let shown = render(output)?;
            let bytes: Vec<u8> = shown.rgb.iter().flatten().map(|value| code(*value)).collect();
            let png = match output {
                SurfaceOutput::Reflectance | SurfaceOutput::Mask => {
                    let grey: Vec<u8> = bytes.iter().step_by(3).copied().collect();
                    picture::encode_grey_png(shown.width, shown.height, &grey)?
                }
                _ => picture::encode_png(shown.width, shown.height, &bytes)?,
            };
            self.put(map, Path::new(picture), &png)?;
        }
        Ok(())
    }

    /// Writes the files that need all pictures, and returns the list of all files.
    pub fn finish(mut self) -> Result<Value> {
        let mut listing = json!({});
        if self.wants(Map::Range) {
            let scale = Scale::of(&mut self.votes);
            for range in std::mem::take(&mut self.ranges) {
                let bytes = std::fs::read(&range.npy).map_err(CliError::io("read", &range.npy))?;
                let numbers = bytes.get(NPY_HEADER..).unwrap_or_default().chunks_exact(4);
                let grey: Vec<u8> =
                    numbers.map(|b| scale.grey(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect();
                let png = picture::encode_grey_png(range.width, range.height, &grey)?;
                let path = range.npy.with_extension("png");
                std::fs::write(&path, png).map_err(CliError::io("write", &path))?;
            }
            let said = scale.json();
            self.put(Map::Range, Path::new("scale.json"), format!("{said:#}\n").as_bytes())?;
            listing["range_scale"] = said;
        }
        for map in &self.maps {
            let of_map = self.files.iter().filter(|(of, path)| of == map && !path.ends_with("scale.json"));
            listing[map.folder()] = of_map.map(|(_, path)| json!(path)).collect();
        }
        Ok(listing)
    }

    fn put(&mut self, map: Map, name: &Path, bytes: &[u8]) -> Result<PathBuf> {
        let path = self.folder.join(map.folder()).join(name);
        std::fs::write(&path, bytes).map_err(CliError::io("write", &path))?;
        self.files.push((map, path.clone()));
        Ok(path)
    }

    /// Samples ranges of pixels that are more than half covered; translucent pixels have no certain range.
    fn vote(&mut self, range: &[f32], alpha: &[f32]) {
        let step = range.len().div_ceil(SAMPLES_PER_PICTURE).max(1);
        let some = range.iter().zip(alpha).step_by(step);
        self.votes.extend(some.filter(|(_, alpha)| **alpha > 0.5).map(|(range, _)| range));
    }
}

impl Scale {
    /// From the nearest to the farthest of `votes`, without outliers.
    fn of(votes: &mut [f32]) -> Self {
        votes.sort_unstable_by(f32::total_cmp);
        let last = votes.len().saturating_sub(1) as f64;
        let at = |share: f64| votes.get((share * last).round() as usize).copied();
        match (at(EXCLUDED_SHARE), at(1.0 - EXCLUDED_SHARE)) {
            (Some(near), Some(far)) => Self { near, far },
            _ => Self { near: 0.0, far: 1.0 },
        }
    }

    /// 255 at `near` to 1 at `far`; 0 for a range of 0, which is nothing.
    fn grey(&self, range: f32) -> u8 {
        let seen = range > 0.0;
        if !seen {
            return 0;
        }
        let share = (range - self.near) / (self.far - self.near).max(f32::MIN_POSITIVE);
        (255.0 - 254.0 * share.clamp(0.0, 1.0)).round() as u8
    }

    fn json(&self) -> Value {
        json!({
            "unit": "scene units along the ray",
            "png_255": self.near,
            "png_1": self.far,
            "png_0": "nothing",
            "numbers": "the .npy beside each PNG",
        })
    }
}

/// 0 to 1 as 8 bits.
fn code(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rendered(range: &[f32], alpha: &[f32]) -> Rendered {
        let rgb = vec![[0.0; 3]; range.len()];
        Rendered { width: range.len() as u32, height: 1, rgb, alpha: alpha.to_vec(), range: range.to_vec() }
    }

    #[test]
    fn all_pictures_share_one_scale_and_strays_do_not_stretch_it() {
        let mut votes: Vec<f32> = (0..1000).map(|index| 5.0 + index as f32 / 1000.0).collect();
        votes.extend([1e6, 0.001]);
        let scale = Scale::of(&mut votes);
        assert!((scale.near - 5.01).abs() < 0.01 && (scale.far - 5.99).abs() < 0.01, "{scale:?}");
        let greys = [0.0, 1.0, scale.near, 5.5, scale.far, 1e9].map(|range| scale.grey(range));
        assert_eq!((greys[0], greys[1], greys[2], greys[4], greys[5]), (0, 255, 255, 1, 1));
        assert!((126..131).contains(&greys[3]), "{greys:?}");
        let nothing = Scale::of(&mut []);
        assert_eq!(nothing.grey(0.0), 0);
        let flat = Scale::of(&mut [2.0, 2.0]);
        assert_eq!((flat.grey(2.0), flat.grey(3.0)), (255, 1));
    }

    #[test]
    fn maps_match_the_render_and_are_in_their_folders() {
        let folder = tempfile::tempdir().expect("a folder");
        let maps = [Map::Normal, Map::Range, Map::Alpha, Map::Range];
        let mut writer = MapWriter::new(folder.path(), &maps).expect("folders");
        let normals = [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0; 3]];
        writer.write("a.b.png", &rendered(&[2.0, 1.5, 0.0], &[1.0, 0.5, 0.0]), Some(&normals)).expect("maps");
        let listing = writer.finish().expect("maps");
        for name in ["range", "alpha", "normal"] {
            assert_eq!(listing[name].as_array().map(Vec::len), Some(1), "{listing}");
        }
        let npy = std::fs::read(folder.path().join("range/a.b.npy")).expect("an array");
        let numbers: Vec<f32> =
            npy[NPY_HEADER..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        assert_eq!(numbers, [2.0, 3.0, 0.0], "the expected range: accumulated over alpha");
        let open = |name: &str| image::open(folder.path().join(name)).expect(name);
        assert_eq!(open("alpha/a.b.png").to_luma8().into_raw(), [255, 128, 0]);
        assert_eq!(open("normal/a.b.png").to_rgb8().into_raw(), [128, 128, 0, 255, 128, 128, 128, 128, 128]);
        assert_eq!(open("range/a.b.png").to_luma8().into_raw()[2], 0);
        assert!(folder.path().join("range/scale.json").is_file());
    }
}
