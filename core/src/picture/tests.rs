use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, LumaA, Rgb, Rgba};

use super::*;
use crate::scene::CameraModel;

fn pinhole(width: u32, height: u32) -> Camera {
    let params = vec![100.0, 100.0, f64::from(width) / 2.0, f64::from(height) / 2.0];
    Camera { id: 1, model: CameraModel::Pinhole, width, height, params }
}

fn file(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn prepare_at(image: &[u8], mask: Option<&[u8]>, camera: &Camera, max: u32) -> Result<PackedImage> {
    prepare(&Photograph { name: "dive/one.png", image, mask }, camera, MaskKeep::White, max)
        .map(|pair| pair.1)
}

fn rgb_test_picture(width: u32, height: u32) -> ImageBuffer<Rgb<u8>, Vec<u8>> {
    ImageBuffer::from_fn(width, height, |x, y| Rgb([(x * 5) as u8, (y * 7) as u8, (x * y % 256) as u8]))
}

#[test]
fn a_picture_that_needs_no_change_keeps_every_byte() {
    let picture = rgb_test_picture(13, 9);
    for format in [ImageFormat::Png, ImageFormat::Tiff] {
        let bytes = file(picture.clone(), format);
        let packed = prepare_at(&bytes, None, &pinhole(13, 9), 1600).unwrap();
        assert_eq!(packed, PackedImage::from_rgb8(13, 9, picture.as_raw()), "{format:?}");
    }
}

#[test]
fn every_kind_of_samples_gives_the_same_picture() {
    let value = |x: u32, y: u32| (x * 19 + y * 3) as u8;
    let grey = |bits16: bool, alpha: bool| -> DynamicImage {
        let wide = |x, y| u16::from(value(x, y)) * 257;
        match (bits16, alpha) {
            (false, false) => ImageBuffer::from_fn(12, 5, |x, y| Luma([value(x, y)])).into(),
            (false, true) => ImageBuffer::from_fn(12, 5, |x, y| LumaA([value(x, y), 255])).into(),
            (true, false) => ImageBuffer::from_fn(12, 5, |x, y| Luma([wide(x, y)])).into(),
            (true, true) => ImageBuffer::from_fn(12, 5, |x, y| LumaA([wide(x, y), 65_535])).into(),
        }
    };
    let colour = |bits16: bool, alpha: bool| -> DynamicImage {
        let picture = grey(bits16, alpha);
        match (bits16, alpha) {
            (false, false) => picture.to_rgb8().into(),
            (false, true) => picture.to_rgba8().into(),
            (true, false) => picture.to_rgb16().into(),
            (true, true) => picture.to_rgba16().into(),
        }
    };
    let expected: Vec<u8> = (0..60).flat_map(|i| [value(i % 12, i / 12); 3]).collect();
    let expected = PackedImage::from_rgb8(12, 5, &expected);
    let mut tried = 0;
    for (bits16, alpha) in [(false, false), (false, true), (true, false), (true, true)] {
        for picture in [grey(bits16, alpha), colour(bits16, alpha)] {
            let kind = picture.color();
            let mut formats = vec![ImageFormat::Png];
            // The encoder cannot write a TIFF of grey with alpha.
            if !(alpha && kind.channel_count() == 2) {
                formats.push(ImageFormat::Tiff);
            }
            for format in formats {
                let packed = prepare_at(&file(picture.clone(), format), None, &pinhole(12, 5), 99).unwrap();
                assert_eq!(packed, expected, "{kind:?} as {format:?}");
                tried += 1;
            }
        }
    }
    assert_eq!(tried, 14);
}

#[test]
fn sizes_are_reduced_in_linear_light_with_the_half_pixel_rule() {
    // Columns of black and white: half the light is sRGB 188, not 128.
    let stripes = ImageBuffer::from_fn(64, 32, |x, _| Luma([if x % 2 == 0 { 0_u8 } else { 255 }]));
    let camera = Camera { params: vec![50.0, 60.0, 31.5, 17.25], ..pinhole(64, 32) };
    let bytes = file(stripes, ImageFormat::Png);
    let photograph = Photograph { name: "stripes", image: &bytes, mask: None };
    let (small, packed) = prepare(&photograph, &camera, MaskKeep::White, 32).unwrap();
    assert_eq!(packed, PackedImage::from_rgb8(32, 16, &[188; 32 * 16 * 3]));
    assert_eq!((small.width, small.height), (32, 16));
    assert_eq!((small.fx, small.fy, small.cx, small.cy), (25.0, 30.0, 15.75, 8.625));
    assert_eq!(prepared_camera(&camera, 32).unwrap(), small);
}

#[test]
fn a_reduction_by_a_fraction_weighs_pixels_by_their_area() {
    // 3 columns to 2: (c0 + c1/2) / 1.5 and (c1/2 + c2) / 1.5 in linear light.
    let row = [10_u8, 200, 90];
    let picture = ImageBuffer::from_fn(3, 1, |x, _| Luma([row[x as usize]]));
    let packed = prepare_at(&file(picture, ImageFormat::Png), None, &pinhole(3, 1), 2).unwrap();
    let linear = row.map(|code| srgb_to_linear(f64::from(code) / 255.0));
    let expected = [(linear[0] + linear[1] / 2.0) / 1.5, (linear[1] / 2.0 + linear[2]) / 1.5]
        .map(|value| (linear_to_srgb(value) * 255.0).round() as u8);
    let rgb = packed.to_rgb8();
    assert_eq!([rgb[0], rgb[3]], expected);
}

#[test]
fn halves_of_odd_pictures_keep_a_constant_and_the_mean_light() {
    let flat = PackedImage::from_rgb8(7, 5, &[93; 7 * 5 * 3]);
    assert_eq!(half(&flat), PackedImage::from_rgb8(3, 2, &[93; 3 * 2 * 3]));
    assert_eq!(half_size(1, 1), (1, 1));
    let picture = rgb_test_picture(40, 30);
    let whole = PackedImage::from_rgb8(40, 30, picture.as_raw());
    let light = |image: &PackedImage| {
        let rgb = image.to_rgb8();
        rgb.iter().map(|code| srgb_to_linear(f64::from(*code) / 255.0)).sum::<f64>() / rgb.len() as f64
    };
    // Rounding to 8 bits moves a bright pixel by up to 0.005 of light, a mean of hundreds by far less.
    assert!((light(&whole) - light(&half(&whole))).abs() < 1e-3);
}

#[test]
fn a_mask_keeps_white_or_black_and_never_transparent_pixels() {
    let picture = ImageBuffer::from_fn(8, 4, |x, _| Rgba([200_u8, 100, 50, if x < 2 { 0 } else { 255 }]));
    let mask = ImageBuffer::from_fn(8, 4, |_, y| Luma([if y < 2 { 0_u8 } else { 255 }]));
    let (picture, mask) = (file(picture, ImageFormat::Png), file(mask, ImageFormat::Png));
    let counted = |keep: MaskKeep| -> Vec<u32> {
        let photograph = Photograph { name: "p", image: &picture, mask: Some(&mask) };
        let (_, packed) = prepare(&photograph, &pinhole(8, 4), keep, 1600).unwrap();
        assert!(
            packed
                .pixels
                .iter()
                .all(|pixel| matches!(pixel.to_le_bytes(), [200, 100, 50, 255] | [0, 0, 0, 0]))
        );
        (0..32).filter(|i| packed.pixels[*i as usize] != 0).collect()
    };
    let expected =
        |rows: [u32; 2]| -> Vec<u32> { (0..32).filter(|i| i % 8 >= 2 && rows.contains(&(i / 8))).collect() };
    assert_eq!(counted(MaskKeep::White), expected([2, 3]));
    assert_eq!(counted(MaskKeep::Black), expected([0, 1]));
}

#[test]
fn masked_pixels_do_not_bleed_into_their_neighbours() {
    // Left half masked and red, right half green; reduced so that one column is shared.
    let picture =
        ImageBuffer::from_fn(6, 2, |x, _| if x < 3 { Rgb([255_u8, 0, 0]) } else { Rgb([0, 200, 0]) });
    let mask = ImageBuffer::from_fn(6, 2, |x, _| Luma([if x < 3 { 0_u8 } else { 255 }]));
    let (picture, mask) = (file(picture, ImageFormat::Png), file(mask, ImageFormat::Png));
    let packed = prepare_at(&picture, Some(&mask), &pinhole(6, 2), 3).unwrap();
    let pixel = |i: usize| packed.pixels[i].to_le_bytes();
    assert_eq!([pixel(0), pixel(1), pixel(2)], [[0, 0, 0, 0], [0, 200, 0, 255], [0, 200, 0, 255]]);
    assert!((packed.kept_share() - 2.0 / 3.0).abs() < 1e-12);
}

#[test]
fn a_smaller_mask_is_stretched_and_one_of_another_shape_refused() {
    let picture = file(rgb_test_picture(8, 4), ImageFormat::Png);
    let small = ImageBuffer::from_fn(4, 2, |x, _| Luma([if x == 0 { 0_u8 } else { 255 }]));
    let packed = prepare_at(&picture, Some(&file(small, ImageFormat::Png)), &pinhole(8, 4), 99).unwrap();
    assert!((0..32).all(|i| (packed.pixels[i] == 0) == (i % 8 < 2)));
    let square: ImageBuffer<Luma<u8>, _> = ImageBuffer::new(4, 4);
    let error = prepare_at(&picture, Some(&file(square, ImageFormat::Png)), &pinhole(8, 4), 99).unwrap_err();
    assert!(error.to_string().contains("mask of dive/one.png: the mask is 4x4"), "{error}");
    // Refused by its header, so no 4000x2000 pixels are allocated for a photograph of 8x4.
    let mut huge = file(rgb_test_picture(8, 4), ImageFormat::Png);
    huge[16..24].copy_from_slice(&[0, 0, 0x0F, 0xA0, 0, 0, 0x07, 0xD0]);
    let error = prepare_at(&picture, Some(&huge), &pinhole(8, 4), 99).unwrap_err();
    assert!(error.to_string().contains("the mask is 4000x2000"), "{error}");
}

#[test]
fn undistortion_puts_every_point_where_the_pinhole_sees_it() {
    // The photograph shows smooth functions of the ray through the lens; their pinhole picture is known
    // exactly. The inverse of the lens is computed here by iteration, independently of the code.
    let (k, f, c) = (-0.15, 90.0, [41.0, 29.0]);
    let shade =
        |x: f64, y: f64| [0.5 + 0.4 * (4.0 * x).sin(), 0.5 + 0.4 * (5.0 * y).cos(), 0.5 + 0.3 * (x + y)];
    let ray_of = |u: f64, v: f64| {
        let (xd, yd) = ((u - c[0]) / f, (v - c[1]) / f);
        let (mut x, mut y) = (xd, yd);
        for _ in 0..100 {
            let factor = 1.0 + k * (x * x + y * y);
            (x, y) = (xd / factor, yd / factor);
        }
        (x, y)
    };
    let code = |light: f64| (linear_to_srgb(light) * 65_535.0).round() as u16;
    let photograph = ImageBuffer::from_fn(80, 60, |px, py| {
        let (x, y) = ray_of(f64::from(px) + 0.5, f64::from(py) + 0.5);
        Rgb(shade(x, y).map(code))
    });
    let camera = Camera {
        id: 2,
        model: CameraModel::SimpleRadial,
        width: 80,
        height: 60,
        params: vec![f, c[0], c[1], k],
    };
    let packed = prepare_at(&file(photograph, ImageFormat::Png), None, &camera, 1600).unwrap();
    // Barrel distortion: the pinhole of the same focal length sees less than the photograph.
    assert_eq!(packed.kept_share(), 1.0);
    let mut worst = 0.0_f64;
    for (i, pixel) in packed.pixels.iter().enumerate() {
        let (u, v) = ((i % 80) as f64 + 0.5, (i / 80) as f64 + 0.5);
        let expected = shade((u - c[0]) / f, (v - c[1]) / f).map(|light| linear_to_srgb(light) * 255.0);
        for channel in 0..3 {
            worst = worst.max((f64::from(pixel.to_le_bytes()[channel]) - expected[channel]).abs());
        }
    }
    // Half a code of rounding, and bilinear interpolation of curvature (5/90)^2/8 * 0.4 of light: 0.1 codes.
    assert!(worst < 0.75, "{worst} codes off");
}

#[test]
fn pixels_outside_the_photograph_are_masked() {
    let picture = file(ImageBuffer::from_pixel(80, 60, Rgb([9_u8, 99, 199])), ImageFormat::Png);
    let camera =
        Camera { model: CameraModel::SimpleRadial, params: vec![60.0, 40.0, 30.0, 0.1], ..pinhole(80, 60) };
    let packed = prepare_at(&picture, None, &camera, 1600).unwrap();
    assert_eq!(packed.pixels[0], 0);
    assert_eq!(packed.pixels[30 * 80 + 40].to_le_bytes(), [9, 99, 199, 255]);
    assert!((0.5..1.0).contains(&packed.kept_share()), "{}", packed.kept_share());
}

#[test]
fn a_truncated_jpeg_is_refused_by_name_and_byte() {
    let jpeg = file(rgb_test_picture(64, 48), ImageFormat::Jpeg);
    let camera = pinhole(64, 48);
    assert!(prepare_at(&jpeg, None, &camera, 1600).is_ok());
    for cut in [jpeg.len() - 1, jpeg.len() - 2, jpeg.len() * 2 / 3, jpeg.len() / 2, 700, 30, 3] {
        let message = prepare_at(&jpeg[..cut], None, &camera, 1600).unwrap_err().to_string();
        assert!(message.contains("dive/one.png") && message.contains("truncated"), "{cut}: {message}");
    }
    let message = prepare_at(&jpeg[..jpeg.len() - 1], None, &camera, 1600).unwrap_err().to_string();
    assert!(message.contains(&format!("byte {}", jpeg.len() - 1)), "{message}");
    // Data that cameras append after the picture is ignored.
    let appended = [jpeg.as_slice(), &[0; 100]].concat();
    assert!(prepare_at(&appended, None, &camera, 1600).is_ok());
}

#[test]
fn damaged_and_unknown_files_are_refused_by_name() {
    let camera = pinhole(64, 48);
    for format in [ImageFormat::Png, ImageFormat::Tiff] {
        let bytes = file(rgb_test_picture(64, 48), format);
        for cut in [bytes.len() / 2, 20] {
            let message = prepare_at(&bytes[..cut], None, &camera, 1600).unwrap_err().to_string();
            assert!(message.contains("dive/one.png"), "{format:?} cut at {cut}: {message}");
        }
    }
    for (bytes, reason) in
        [(&b""[..], "empty"), (b"GIF89a......", "not a PNG, JPEG or TIFF"), (b"RIFF", "not a PNG")]
    {
        let message = prepare_at(bytes, None, &camera, 1600).unwrap_err().to_string();
        assert!(message.contains("dive/one.png") && message.contains(reason), "{message}");
    }
}

#[test]
fn a_picture_must_have_the_size_of_its_camera() {
    let bytes = file(rgb_test_picture(64, 48), ImageFormat::Png);
    let message = prepare_at(&bytes, None, &pinhole(640, 480), 1600).unwrap_err().to_string();
    assert!(message.contains("64x48") && message.contains("640x480"), "{message}");
    let message = prepare_at(&bytes, None, &pinhole(48, 64), 1600).unwrap_err().to_string();
    assert!(message.contains("EXIF"), "{message}");
}

#[test]
fn headers_give_sizes_without_pixels() {
    let folder = tempfile::tempdir().unwrap();
    for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::Tiff] {
        let path = folder.path().join("picture");
        std::fs::write(&path, file(rgb_test_picture(33, 21), format)).unwrap();
        assert_eq!(dimensions(&path).unwrap(), (33, 21), "{format:?}");
        assert_eq!(dimensions_of_complete(&path).unwrap(), (33, 21), "{format:?}");
    }
}

#[test]
fn png_encoding_is_lossless_and_checks_its_size() {
    let picture = rgb_test_picture(17, 5);
    let png = encode_png(17, 5, picture.as_raw()).unwrap();
    assert_eq!(prepare_at(&png, None, &pinhole(17, 5), 99).unwrap().to_rgb8(), *picture.as_raw());
    assert!(encode_png(17, 6, picture.as_raw()).is_err());
}

/// The start of a PNG of this size.
fn png_header(width: u32, height: u32) -> Vec<u8> {
    let mut png = file(rgb_test_picture(8, 8), ImageFormat::Png);
    png[16..20].copy_from_slice(&width.to_be_bytes());
    png[20..24].copy_from_slice(&height.to_be_bytes());
    png
}

#[test]
fn a_picture_over_the_pixel_limit_is_refused_by_its_header() {
    // About a hundred bytes that declare 13 GB of pixels.
    let bomb = png_header(65_535, 65_535);
    let message = prepare_at(&bomb, None, &pinhole(65_535, 65_535), 1600).unwrap_err().to_string();
    for part in ["dive/one.png", "65535x65535", "the limit is 268 million", "reduce it"] {
        assert!(message.contains(part), "{message}");
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bomb.png");
    std::fs::write(&path, &bomb).unwrap();
    assert!(
        dimensions(&path).unwrap_err().to_string().contains("bomb.png: the picture declares"),
        "at ingest too"
    );
    // The largest allowed size passes the header check; the pixels are missing.
    std::fs::write(&path, png_header(16_384, 16_384)).unwrap();
    assert_eq!(dimensions(&path).unwrap(), (16_384, 16_384));
    let mask = png_header(65_532, 65_532);
    let photograph = file(rgb_test_picture(16, 16), ImageFormat::Png);
    let message = prepare_at(&photograph, Some(&mask), &pinhole(16, 16), 1600).unwrap_err().to_string();
    assert!(
        message.contains("mask of dive/one.png") && message.contains("the limit is 268 million"),
        "{message}"
    );
}

#[test]
fn a_tiff_entry_with_more_values_than_the_file_is_refused() {
    let tiff = file(rgb_test_picture(8, 8), ImageFormat::Tiff);
    assert!(prepare_at(&tiff, None, &pinhole(8, 8), 99).is_ok());
    let start = u32::from_le_bytes(tiff[4..8].try_into().unwrap()) as usize;
    let entries = usize::from(u16::from_le_bytes(tiff[start..start + 2].try_into().unwrap()));
    for entry in 0..entries {
        let mut tiff = tiff.clone();
        let at = start + 2 + 12 * entry + 4;
        tiff[at..at + 4].copy_from_slice(&6_029_313_u32.to_le_bytes());
        let message = prepare_at(&tiff, None, &pinhole(8, 8), 99).unwrap_err().to_string();
        assert!(message.contains("dive/one.png") && message.contains("6029313 values"), "{entry}: {message}");
    }
    let mut tiff = tiff;
    tiff[start..start + 2].copy_from_slice(&u16::MAX.to_le_bytes());
    let message = prepare_at(&tiff, None, &pinhole(8, 8), 99).unwrap_err().to_string();
    assert!(message.contains("65535 entries"), "{message}");
}

#[test]
fn a_jpeg_of_very_many_scans_is_refused_before_it_is_decoded() {
    let jpeg = file(rgb_test_picture(8, 8), ImageFormat::Jpeg);
    let scan = jpeg.windows(2).position(|pair| pair == [0xFF, 0xDA]).unwrap();
    let end = jpeg.len() - 2;
    let with = |scans: usize| [&jpeg[..scan], &jpeg[scan..end].repeat(scans), &jpeg[end..]].concat();
    assert_eq!(header::check_jpeg_end(&with(500)), Ok(()));
    let message = prepare_at(&with(501), None, &pinhole(8, 8), 99).unwrap_err().to_string();
    assert!(message.contains("more than 500 scans"), "{message}");
}
