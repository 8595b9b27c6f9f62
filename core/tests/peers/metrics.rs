//! PSNR, SSIM and the loss against scikit-image and torchmetrics.

use fathom_core::metrics::{psnr, ssim};
use fathom_core::views::PackedImage;
use fathom_twins::{Loss, loss, ssim_map, unpack};
use serde::Deserialize;

use crate::expectations::{assert_close, assert_rows_close, read};

/// The record of `make_metric_expectations.py`.
#[derive(Deserialize)]
struct File {
    pictures: Vec<Pictures>,
    losses: Vec<LossRecord>,
}

/// Two 8-bit pictures and the results of the peers.
#[derive(Deserialize)]
struct Pictures {
    name: String,
    /// Rows of RGB as hexadecimal digits.
    render: Vec<String>,
    truth: Vec<String>,
    /// Rows of 1 (counts) and 0 (masked).
    mask: Vec<String>,
    psnr_db: f64,
    ssim: f64,
    /// Similarity of the red channel at every pixel, for some pairs.
    ssim_map_red: Option<Vec<f64>>,
}

#[derive(Deserialize)]
struct LossRecord {
    name: String,
    width: u32,
    height: u32,
    ssim_weight: f64,
    render: Vec<[f64; 3]>,
    truth: Vec<[f64; 3]>,
    mask: Vec<bool>,
    l1: f64,
    ssim: f64,
    total: f64,
    v_rgb: Vec<[f64; 3]>,
}

impl Pictures {
    /// The render without a mask, and the true picture with the mask.
    fn packed(&self) -> (PackedImage, PackedImage) {
        let mut truth = packed(&self.truth);
        for (pixel, counts) in truth.pixels.iter_mut().zip(self.mask.concat().bytes()) {
            if counts == b'0' {
                *pixel &= 0x00FF_FFFF;
            }
        }
        (packed(&self.render), truth)
    }
}

impl LossRecord {
    fn ours(&self) -> Loss {
        loss(&self.render, &self.truth, &self.mask, self.width, self.height, self.ssim_weight)
    }
}

fn packed(rows: &[String]) -> PackedImage {
    let digits = rows.concat();
    let byte = |i: usize| u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).unwrap();
    let rgb: Vec<u8> = (0..digits.len() / 2).map(byte).collect();
    PackedImage::from_rgb8((rows[0].len() / 6) as u32, rows.len() as u32, &rgb)
}

fn pictures() -> Vec<Pictures> {
    let pictures = read::<File>("metrics").pictures;
    assert!(pictures.len() >= 6 && pictures.iter().any(|case| case.mask.concat().contains('0')));
    pictures
}

fn losses() -> Vec<LossRecord> {
    let losses = read::<File>("metrics").losses;
    assert!(losses.len() >= 3 && losses.iter().any(|case| case.mask.contains(&false)));
    losses
}

#[test]
fn psnr_matches_scikit_image_and_torchmetrics() {
    for case in pictures() {
        let (render, truth) = case.packed();
        assert_close(&case.name, &[psnr(&render, &truth)], &[case.psnr_db]);
    }
}

#[test]
fn ssim_matches_scikit_image_and_torchmetrics_with_the_border() {
    for case in pictures() {
        let (render, truth) = case.packed();
        assert_close(&case.name, &[ssim(&render, &truth)], &[case.ssim]);
    }
}

#[test]
fn the_ssim_map_of_the_loss_matches_the_peers_at_every_pixel() {
    let mut maps = 0;
    for case in pictures() {
        let Some(theirs) = &case.ssim_map_red else { continue };
        let (render, truth) = case.packed();
        let red = |image| -> Vec<f64> { unpack(image).0.iter().map(|rgb| rgb[0]).collect() };
        let ours = ssim_map(&red(&render), &red(&truth), truth.width, truth.height);
        assert_close(&case.name, &ours, theirs);
        maps += 1;
    }
    assert!(maps > 0);
}

#[test]
fn the_loss_matches_torchmetrics() {
    for case in losses() {
        let ours = case.ours();
        assert_close(&case.name, &[ours.l1, ours.ssim, ours.total], &[case.l1, case.ssim, case.total]);
    }
}

#[test]
fn the_loss_gradient_matches_autograd_through_torchmetrics() {
    for case in losses() {
        assert_rows_close(&case.name, &case.ours().v_rgb, &case.v_rgb);
    }
}
