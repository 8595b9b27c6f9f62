//! Projection, blending and all gradients against gsplat's PyTorch reference with autograd.

use fathom_core::scene::{PinholeCamera, Pose};
use fathom_twins::{
    Gaussians64, Raster, RasterGradients, RasterRules, Splat, SplatGradient, project_backward,
    rasterize_backward, render,
};
use serde::Deserialize;

use crate::expectations::{assert_close, assert_rows_close, read};

/// The record of one scene by `make_expectations.py`.
#[derive(Deserialize)]
struct Scene {
    camera: PinholeCamera,
    pose: PoseRecord,
    max_alpha: f64,
    background: [f64; 3],
    /// The degree in use; the model may have a higher one.
    sh_degree: u8,
    model: ModelRecord,
    splats: SplatRecord,
    raster: RasterRecord,
    v_splats: SplatRecord,
    v_model: ModelRecord,
    shows: Counts,
}

#[derive(Deserialize)]
struct PoseRecord {
    quat_wxyz: [f64; 4],
    translation: [f64; 3],
}

/// A model or its gradient; rows as in [`Gaussians64`].
#[derive(Deserialize)]
struct ModelRecord {
    means: Vec<[f64; 3]>,
    quats: Vec<[f64; 4]>,
    log_scales: Vec<[f64; 3]>,
    opacity_logits: Vec<f64>,
    sh_coeffs: Vec<[f64; 3]>,
}

/// Splats or their gradients, by Gaussian; `None` where a Gaussian is behind the camera or too near.
#[derive(Deserialize)]
struct SplatRecord {
    mean2d: Vec<Option<[f64; 2]>>,
    conic: Vec<Option<[f64; 3]>>,
    rgb: Vec<Option<[f64; 3]>>,
    opacity: Vec<Option<f64>>,
    range: Vec<Option<f64>>,
    /// Missing in gradients, because depth only decides the order.
    #[serde(default)]
    depth: Vec<Option<f64>>,
}

#[derive(Deserialize)]
struct RasterRecord {
    rgb: Vec<[f64; 3]>,
    alpha: Vec<f64>,
    range: Vec<f64>,
}

/// How often each edge case occurred in a scene, as counted by the script.
#[derive(Deserialize)]
struct Counts {
    capped_pairs: u32,
    stopped_pixels: u32,
    clamped_ratios: u32,
    behind_or_near: u32,
    transparent: u32,
    black_channels: u32,
}

/// A recorded scene and the results of the twins.
struct Case {
    name: &'static str,
    theirs: Scene,
    splats: Vec<Option<Splat>>,
    raster: Raster,
    v_splats: Vec<SplatGradient>,
    v_model: Gaussians64,
}

const SCENES: [&str; 5] = ["crowd", "opaque", "opaque_gsplat", "needles", "border"];

/// Every scene through the twins, forward and backward.
fn cases() -> Vec<Case> {
    SCENES.into_iter().map(Case::new).collect()
}

impl Case {
    fn new(name: &'static str) -> Self {
        let theirs: Scene = read(name);
        let model = theirs.model.gaussians();
        let camera = &theirs.camera;
        let pose = Pose::from_wxyz(theirs.pose.quat_wxyz, theirs.pose.translation);
        let rules = RasterRules { max_alpha: theirs.max_alpha, ..RasterRules::HARD };
        let (splats, lists, raster) =
            render(&model, camera, &pose, theirs.sh_degree, theirs.background, &rules);
        let v_raster = weights(camera.width * camera.height);
        let v_splats = rasterize_backward(&splats, &lists, &raster, theirs.background, &rules, &v_raster);
        let v_model = project_backward(&model, camera, &pose, theirs.sh_degree, &splats, &v_splats, &rules);
        Self { name, theirs, splats, raster, v_splats, v_model }
    }

    /// Compares one number (or array) of the splats for all Gaussians that we draw; gsplat must draw them
    /// too.
    fn assert_splats<const N: usize>(
        &self,
        what: &str,
        theirs: &[Option<[f64; N]>],
        ours: impl Fn(&Splat, &SplatGradient) -> [f64; N],
    ) {
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for (i, splat) in self.splats.iter().enumerate() {
            if let Some(splat) = splat {
                a.push(ours(splat, &self.v_splats[i]));
                b.push(theirs[i].unwrap_or_else(|| {
                    panic!("{}: gsplat does not draw Gaussian {i}, but we do", self.name)
                }));
            }
        }
        assert_rows_close(&format!("{}, {what}", self.name), &a, &b);
    }

    fn what(&self, what: &str) -> String {
        format!("{}, {what}", self.name)
    }
}

impl ModelRecord {
    fn gaussians(&self) -> Gaussians64 {
        let coeffs = self.sh_coeffs.len() / self.means.len();
        Gaussians64 {
            sh_degree: (coeffs.isqrt() - 1) as u8,
            means: self.means.clone(),
            quats: self.quats.clone(),
            log_scales: self.log_scales.clone(),
            opacity_logits: self.opacity_logits.clone(),
            sh_coeffs: self.sh_coeffs.clone(),
        }
    }
}

/// The weights of the loss: the formula of `weights` in `make_expectations.py`.
fn weights(pixels: u32) -> RasterGradients {
    let weight = |pixel: u32, channel: u64| {
        let k = u64::from(pixel) * 5 + channel;
        ((k * k * 31 + k * 7919) % 2003) as f64 / 1001.0 - 1.0
    };
    RasterGradients {
        rgb: (0..pixels).map(|i| [weight(i, 0), weight(i, 1), weight(i, 2)]).collect(),
        alpha: (0..pixels).map(|i| weight(i, 3)).collect(),
        range: (0..pixels).map(|i| weight(i, 4)).collect(),
    }
}

fn single(values: &[Option<f64>]) -> Vec<Option<[f64; 1]>> {
    values.iter().map(|value| value.map(|v| [v])).collect()
}

#[test]
fn scenes_show_every_edge_and_one_has_gsplats_cap_of_alpha() {
    type Count = (&'static str, fn(&Counts) -> u32);
    let cases = cases();
    for case in &cases {
        let ours = case.theirs.max_alpha == RasterRules::HARD.max_alpha;
        assert_eq!(ours, case.name != "opaque_gsplat", "{}: the cap of alpha", case.name);
    }
    let shows: Vec<Counts> = cases.into_iter().map(|case| case.theirs.shows).collect();
    let counts: [Count; 6] = [
        ("alpha at its cap", |c| c.capped_pairs),
        ("rays that end", |c| c.stopped_pixels),
        ("ratios that are clamped in the Jacobian", |c| c.clamped_ratios),
        ("Gaussians behind the camera or too near", |c| c.behind_or_near),
        ("Gaussians under 1/255", |c| c.transparent),
        ("channels that are clamped at 0", |c| c.black_channels),
    ];
    for (what, count) in counts {
        assert!(shows.iter().map(count).sum::<u32>() > 0, "{what}");
    }
}

#[test]
fn only_gaussians_behind_too_near_or_transparent_are_culled() {
    for case in cases() {
        for (i, splat) in case.splats.iter().enumerate() {
            let drawn = case.theirs.splats.opacity[i].is_some_and(|opacity| opacity >= 1.0 / 255.0);
            assert_eq!(splat.is_some(), drawn, "{}, Gaussian {i}", case.name);
        }
    }
}

#[test]
fn projected_centres_match_gsplat() {
    for case in cases() {
        case.assert_splats("centre", &case.theirs.splats.mean2d, |splat, _| splat.mean2d);
    }
}

#[test]
fn conics_match_gsplat() {
    for case in cases() {
        case.assert_splats("conic", &case.theirs.splats.conic, |splat, _| splat.conic);
    }
}

#[test]
fn depths_and_ranges_match_gsplat() {
    for case in cases() {
        case.assert_splats("depth", &single(&case.theirs.splats.depth), |splat, _| [splat.depth]);
        case.assert_splats("range", &single(&case.theirs.splats.range), |splat, _| [splat.range]);
    }
}

#[test]
fn opacities_and_colours_match_gsplat() {
    for case in cases() {
        case.assert_splats("opacity", &single(&case.theirs.splats.opacity), |splat, _| [splat.opacity]);
        case.assert_splats("colour", &case.theirs.splats.rgb, |splat, _| splat.rgb);
    }
}

#[test]
fn rendered_colours_match_gsplat() {
    for case in cases() {
        assert_rows_close(&case.what("colour"), &case.raster.rgb, &case.theirs.raster.rgb);
    }
}

#[test]
fn rendered_alphas_and_ranges_match_gsplat() {
    for case in cases() {
        assert_close(&case.what("alpha"), &case.raster.alpha, &case.theirs.raster.alpha);
        assert_close(&case.what("range"), &case.raster.range, &case.theirs.raster.range);
    }
}

#[test]
fn gradients_of_splats_match_autograd() {
    for case in cases() {
        let theirs = &case.theirs.v_splats;
        case.assert_splats("gradient of conic", &theirs.conic, |_, v| v.conic);
        case.assert_splats("gradient of colour", &theirs.rgb, |_, v| v.rgb);
        case.assert_splats("gradient of opacity", &single(&theirs.opacity), |_, v| [v.opacity]);
        case.assert_splats("gradient of range", &single(&theirs.range), |_, v| [v.range]);
    }
}

#[test]
fn gradients_of_projected_centres_match_autograd() {
    for case in cases() {
        case.assert_splats("gradient of centre", &case.theirs.v_splats.mean2d, |_, v| v.mean2d);
    }
}

#[test]
fn gradients_of_means_match_autograd() {
    for case in cases() {
        assert_rows_close(&case.what("means"), &case.v_model.means, &case.theirs.v_model.means);
    }
}

#[test]
fn gradients_of_quaternions_match_autograd() {
    for case in cases() {
        assert_rows_close(&case.what("quaternions"), &case.v_model.quats, &case.theirs.v_model.quats);
    }
}

#[test]
fn gradients_of_log_scales_match_autograd() {
    for case in cases() {
        assert_rows_close(
            &case.what("log scales"),
            &case.v_model.log_scales,
            &case.theirs.v_model.log_scales,
        );
    }
}

#[test]
fn gradients_of_opacity_logits_match_autograd() {
    for case in cases() {
        let theirs = &case.theirs.v_model.opacity_logits;
        assert_close(&case.what("opacity logits"), &case.v_model.opacity_logits, theirs);
    }
}

#[test]
fn gradients_of_sh_coefficients_match_autograd() {
    for case in cases() {
        let theirs = &case.theirs.v_model.sh_coeffs;
        assert_rows_close(&case.what("SH coefficients"), &case.v_model.sh_coeffs, theirs);
    }
}
