//! All stages of one view: Gaussians -> image -> loss -> gradient of every parameter.

use super::{
    Gaussians64, Loss, Raster, RasterGradients, RasterRules, Splat, SplatGradient, TileLists, intersect,
    loss, project_backward, project_forward, rasterize_backward, rasterize_forward,
};
use fathom_core::scene::{PinholeCamera, Pose};

/// The inputs of training on one view.
#[derive(Clone, Debug)]
pub struct ViewInput<'a> {
    /// Pinhole camera.
    pub camera: &'a PinholeCamera,
    /// World to camera.
    pub pose: &'a Pose,
    /// SH degree that the schedule has reached.
    pub sh_degree: u8,
    /// Colour behind everything.
    pub background: [f64; 3],
    /// Photograph, `[H*W]`.
    pub truth: &'a [[f64; 3]],
    /// Which pixels count, `[H*W]`.
    pub mask: &'a [bool],
    /// Weight of 1 - SSIM against L1.
    pub ssim_weight: f64,
}

/// Every intermediate of one view, so that any kernel can be compared at its own stage.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewGradients {
    /// After `project_forward`, by Gaussian.
    pub splats: Vec<Option<Splat>>,
    /// After `intersect`.
    pub lists: TileLists,
    /// After `rasterize_forward`.
    pub raster: Raster,
    /// After `loss`.
    pub loss: Loss,
    /// After `rasterize_backward`, by Gaussian.
    pub v_splats: Vec<SplatGradient>,
    /// After `project_backward`.
    pub v_model: Gaussians64,
}

/// Renders `model` over `background`.
pub fn render(
    model: &Gaussians64,
    camera: &PinholeCamera,
    pose: &Pose,
    sh_degree: u8,
    background: [f64; 3],
    rules: &RasterRules,
) -> (Vec<Option<Splat>>, TileLists, Raster) {
    let splats = project_forward(model, camera, pose, sh_degree, rules);
    let lists = intersect(&splats, camera.width, camera.height);
    let raster = rasterize_forward(&splats, &lists, camera.width, camera.height, background, rules);
    (splats, lists, raster)
}

/// Loss of `model` on one view and its gradient with respect to every parameter, without the regularisers.
pub fn view_gradients(model: &Gaussians64, view: &ViewInput<'_>, rules: &RasterRules) -> ViewGradients {
    let (camera, pose) = (view.camera, view.pose);
    let (splats, lists, raster) = render(model, camera, pose, view.sh_degree, view.background, rules);
    let loss = loss(&raster.rgb, view.truth, view.mask, camera.width, camera.height, view.ssim_weight);
    let v_raster = RasterGradients::of_colour(loss.v_rgb.clone());
    let v_splats = rasterize_backward(&splats, &lists, &raster, view.background, rules, &v_raster);
    let v_model = project_backward(model, camera, pose, view.sh_degree, &splats, &v_splats, rules);
    ViewGradients { splats, lists, raster, loss, v_splats, v_model }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::brute_force::brute_force;
    use crate::finite_differences::{assert_close, derivative};
    use crate::samples::{all, degenerate, off_centre_view, random};
    use fathom_core::harmonics::sh_basis;
    use fathom_core::rng::{Stream, uniform_at};

    const BACKGROUND: [f64; 3] = [0.1, 0.3, 0.6];

    fn photograph(pixels: u32) -> (Vec<[f64; 3]>, Vec<bool>) {
        let u = |i, j| f64::from(uniform_at(41, Stream::Test, i, j));
        (
            (0..pixels).map(|i| [u(i, 0), u(i, 1), u(i, 2)]).collect(),
            (0..pixels).map(|i| u(i, 3) > 0.1).collect(),
        )
    }

    #[test]
    fn the_tiled_renderer_matches_one_without_tiles() {
        for (width, height) in [(75, 53), (16, 16), (17, 1), (1, 33)] {
            let (camera, pose) = off_centre_view(width, height, 3.0);
            for rules in [RasterRules::HARD, RasterRules::SMOOTH] {
                for (name, model) in all(42, 60, 3) {
                    let (_, _, raster) = render(&model, &camera, &pose, 3, BACKGROUND, &rules);
                    let colour = |i: usize, direction: DVec3| {
                        let basis = sh_basis(direction);
                        let coeffs = &model.sh_coeffs[16 * i..16 * (i + 1)];
                        coeffs.iter().zip(basis).map(|(c, y)| y * DVec3::from(*c)).sum::<DVec3>() + 0.5
                    };
                    let pixels = brute_force(&model, &camera, &pose, BACKGROUND.into(), &rules, colour);
                    for (i, pixel) in pixels.iter().enumerate() {
                        // Sums of 60 numbers near 1; covariances of needles have condition numbers of 1e4.
                        let close = |a: f64, b: f64| (a - b).abs() < 1e-10;
                        assert!(
                            (0..3).all(|c| close(raster.rgb[i][c], pixel.rgb[c]))
                                && close(raster.alpha[i], pixel.alpha)
                                && close(raster.range[i], pixel.range),
                            "{name}, {rules:?}, pixel {i} of {width}x{height}: {:?} {} {} against {pixel:?}",
                            raster.rgb[i],
                            raster.alpha[i],
                            raster.range[i]
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn every_gradient_of_the_loss_is_its_central_difference() {
        let (width, height) = (21, 18);
        let (camera, pose) = off_centre_view(width, height, 3.0);
        let (truth, mask) = photograph(width * height);
        for sh_degree in 0..=3 {
            for (name, model) in all(43 + u32::from(sh_degree), 7, sh_degree) {
                let view = ViewInput {
                    camera: &camera,
                    pose: &pose,
                    sh_degree,
                    background: BACKGROUND,
                    truth: &truth,
                    mask: &mask,
                    ssim_weight: 0.2,
                };
                let result = view_gradients(&model, &view, &RasterRules::SMOOTH);
                let total = |model: &Gaussians64| {
                    let (_, _, raster) =
                        render(model, &camera, &pose, sh_degree, BACKGROUND, &RasterRules::SMOOTH);
                    loss(&raster.rgb, &truth, &mask, width, height, view.ssim_weight).total
                };
                assert_eq!(total(&model), result.loss.total);
                for id in 0..model.len() {
                    for parameter in 0..model.parameters() {
                        let numeric = derivative(|h| {
                            let mut moved = model.clone();
                            *moved.parameter_mut(id, parameter) += h;
                            total(&moved)
                        });
                        let parameter_name = Gaussians64::parameter_name(parameter);
                        let what = format!("{name}, degree {sh_degree}, {parameter_name} of Gaussian {id}");
                        // The loss is near 0.4, so rounding is 1e-12; 1e-4 RELATIVE is a hundred times that.
                        assert_close(&what, result.v_model.parameter(id, parameter), numeric, 1e-4);
                    }
                }
            }
        }
    }

    #[test]
    fn degenerate_gaussians_change_nothing_of_the_others() {
        let (width, height) = (37, 29);
        let (camera, pose) = off_centre_view(width, height, 3.0);
        let (truth, mask) = photograph(width * height);
        let view = ViewInput {
            camera: &camera,
            pose: &pose,
            sh_degree: 2,
            background: BACKGROUND,
            truth: &truth,
            mask: &mask,
            ssim_weight: 0.2,
        };
        let (faulty, names) = degenerate(2);
        let mut model = random(44, 30, 2);
        let clean = view_gradients(&Gaussians64::from(&model), &view, &RasterRules::HARD);
        for id in 0..faulty.len() {
            model.push_from(&faulty, id);
        }
        let spoiled = view_gradients(&Gaussians64::from(&model), &view, &RasterRules::HARD);
        assert_eq!(spoiled.raster, clean.raster);
        assert_eq!(spoiled.loss, clean.loss);
        assert_eq!(spoiled.v_splats[..30], clean.v_splats[..]);
        for parameter in 0..clean.v_model.parameters() {
            for id in 0..30 {
                assert_eq!(spoiled.v_model.parameter(id, parameter), clean.v_model.parameter(id, parameter));
            }
            for (id, name) in names.iter().enumerate() {
                assert_eq!(spoiled.v_model.parameter(30 + id, parameter), 0.0, "{name}");
            }
        }
    }

    #[test]
    fn an_empty_model_renders_the_background() {
        let (camera, pose) = off_centre_view(20, 10, 3.0);
        let (_, lists, raster) =
            render(&Gaussians64::zeros(0, 3), &camera, &pose, 3, BACKGROUND, &RasterRules::HARD);
        assert_eq!(lists.ranges, [[0, 0]; 2]);
        assert!(raster.rgb.iter().all(|&c| c == BACKGROUND));
        assert!(raster.alpha.iter().chain(&raster.range).all(|&v| v == 0.0));
    }

    #[test]
    fn a_wall_in_front_ends_a_pixel() {
        // The first wall leaves 0.01. The second would leave 1e-4, and rounding decides whether that is below
        // the limit. The third would leave 1e-6 and is never blended.
        let (camera, pose) = off_centre_view(16, 16, 3.0);
        let mut model = Gaussians64::zeros(4, 0);
        for (i, mean) in model.means.iter_mut().enumerate() {
            *mean = [0.0, 0.0, 0.2 * i as f64];
        }
        model.quats.fill([1.0, 0.0, 0.0, 0.0]);
        model.log_scales.fill([3.0; 3]);
        model.opacity_logits.fill(20.0);
        let (_, _, raster) = render(&model, &camera, &pose, 0, BACKGROUND, &RasterRules::HARD);
        assert!(raster.last.iter().all(|&last| last <= 2), "{:?}", raster.last);
        assert!(raster.transmittance.iter().all(|&t| (1e-4..0.02).contains(&t)));
    }
}
