//! Photographs and masks, decoded with the function that workers use.

use fathom_core::config::MaskKeep;
use fathom_core::picture::{self, Photograph};
use fathom_core::scene::{Camera, CameraModel};
use fathom_fuzz::{Folder, Target, run};
use image::{ExtendedColorType, ImageEncoder};

use crate::Bytes;

const WIDTH: u32 = 9;
const HEIGHT: u32 = 7;
/// Memory that a decoder may use in addition to the picture.
const DECODER_BYTES: u64 = 64 << 20;
/// Pictures whose header names more pixels are only decoded against a camera of another size. Otherwise they
/// would take the memory for that many pixels, up to a limit that another test checks.
const MOST_PIXELS: u64 = 1 << 16;

fn camera((width, height): (u32, u32)) -> Camera {
    let params = vec![8.0, 8.0, f64::from(width) / 2.0, f64::from(height) / 2.0];
    Camera { id: 1, model: CameraModel::Pinhole, width, height, params }
}

fn samples(count: u32) -> Vec<u8> {
    (0..WIDTH * HEIGHT * count).map(|index| (index * 37 % 251) as u8).collect()
}

fn png(colour: ExtendedColorType) -> Vec<u8> {
    let mut png = Vec::new();
    let bytes = u32::from(colour.bits_per_pixel()) / 8;
    let encoder = image::codecs::png::PngEncoder::new(&mut png);
    encoder.write_image(&samples(bytes), WIDTH, HEIGHT, colour).unwrap();
    png
}

fn jpeg(colour: ExtendedColorType) -> Vec<u8> {
    let mut jpeg = Vec::new();
    let channels = u32::from(colour.channel_count());
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 80)
        .write_image(&samples(channels), WIDTH, HEIGHT, colour)
        .unwrap();
    jpeg
}

/// A grey JPEG of 8 x 8 in two scans. It has the standard Huffman tables, which the encoder writes: 00 is a
/// DC coefficient without bits, 1010 ends a block of AC coefficients.
fn progressive_jpeg() -> Vec<u8> {
    let whole = jpeg(ExtendedColorType::L8);
    let scan = whole.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap();
    let mut head = whole[..scan].to_vec();
    let frame = head.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
    head[frame + 1] = 0xc2;
    head[frame + 5..frame + 9].copy_from_slice(&[0, 8, 0, 8]);
    let scans: [&[u8]; 4] = [
        &[0xff, 0xda, 0, 8, 1, 1, 0x00, 0, 0, 0],
        &[0x3f],
        &[0xff, 0xda, 0, 8, 1, 1, 0x00, 1, 63, 0],
        &[0xaf, 0xff, 0xd9],
    ];
    [&head, &scans.concat()[..]].concat()
}

/// Rows of RGB in one strip with this compression of TIFF 6.0.
fn tiff(compression: u16) -> Vec<u8> {
    let pixels = samples(3);
    let strip = match compression {
        // LZW: each sample is a code of 9 bits; the table is cleared before codes need 10.
        5 => {
            let codes = pixels
                .chunks(200)
                .flat_map(|chunk| std::iter::once(256).chain(chunk.iter().map(|byte| u16::from(*byte))));
            let bits: Vec<bool> = codes
                .chain([257])
                .flat_map(|code| (0..9).rev().map(move |bit| code >> bit & 1 == 1))
                .collect();
            bits.chunks(8)
                .map(|bits| {
                    bits.iter().rev().zip(8 - bits.len()..).map(|(bit, at)| u8::from(*bit) << at).sum()
                })
                .collect()
        }
        // Deflate: one stored block and its checksum.
        8 => {
            let (mut a, mut b) = (1_u32, 0_u32);
            for byte in &pixels {
                a = (a + u32::from(*byte)) % 65_521;
                b = (b + a) % 65_521;
            }
            let length = pixels.len() as u16;
            let head = Bytes::default().u8s(&[0x78, 0x01, 0x01]).u16(length).u16(!length);
            head.u8s(&pixels).u8s(&(b << 16 | a).to_be_bytes()).0
        }
        32_773 => pixels.chunks(128).flat_map(|chunk| [&[chunk.len() as u8 - 1], chunk].concat()).collect(),
        _ => pixels,
    };
    // Header, strip, bits of the three samples, then the directory.
    let bits_at = 8 + strip.len() as u32 + strip.len() as u32 % 2;
    let fields: [(u16, u16, u32, u32); 9] = [
        (256, 4, 1, WIDTH),
        (257, 4, 1, HEIGHT),
        (258, 3, 3, bits_at),
        (259, 3, 1, compression.into()),
        (262, 3, 1, 2),
        (273, 4, 1, 8),
        (277, 3, 1, 3),
        (278, 4, 1, HEIGHT),
        (279, 4, 1, strip.len() as u32),
    ];
    let mut tiff = Bytes::default().u8s(b"II").u16(42).u32(bits_at + 6).u8s(&strip);
    tiff.0.resize(bits_at as usize, 0);
    tiff = tiff.u16(8).u16(8).u16(8).u16(fields.len() as u16);
    for (tag, kind, count, value) in fields {
        tiff = tiff.u16(tag).u16(kind).u32(count).u32(value);
    }
    tiff.u32(0).0
}

/// Corrects the checksums of the chunks of a PNG.
fn mend_png(png: &mut [u8]) {
    let mut at = 8;
    while let Some(head) = png.get(at..at + 8) {
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        let Some(end) = (at + 8).checked_add(length).filter(|end| end + 4 <= png.len()) else { return };
        let sum = crc32(&png[at + 4..end]);
        png[end..end + 4].copy_from_slice(&sum.to_be_bytes());
        at = end + 4;
    }
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0_u32, |sum, byte| {
        (0..8).fold(sum ^ u32::from(*byte), |sum, _| (sum >> 1) ^ (0xedb8_8320 & (sum & 1).wrapping_neg()))
    })
}

fn photographs(name: &str, corpus: Vec<Vec<u8>>, mend: Option<fn(&mut [u8])>) {
    let folder = Folder::new(name);
    let read = |bytes: &[u8]| {
        // As at ingest: only the header is read.
        let path = folder.put("photograph", bytes);
        let (size, complete) = (picture::dimensions(&path), picture::dimensions_of_complete(&path));
        assert!(size.is_ok() || complete.is_err());
        // Then as in a worker, with a camera of the size in the header.
        let expected = size.ok().filter(|(w, h)| u64::from(*w) * u64::from(*h) <= MOST_PIXELS);
        let camera = camera(expected.unwrap_or((WIDTH, HEIGHT)));
        let photograph = Photograph { name: "photograph", image: bytes, mask: None };
        let Ok((pinhole, image)) = picture::prepare(&photograph, &camera, MaskKeep::White, 64) else {
            return false;
        };
        assert_eq!(image.pixels.len(), (pinhole.width * pinhole.height) as usize);
        true
    };
    run(&Target { mend, extra_bytes: DECODER_BYTES, inputs: 1000, ..Target::new(name, corpus, &read) });
}

#[test]
fn fuzzed_pngs_are_decoded_or_refused() {
    use ExtendedColorType::{L8, L16, La8, Rgb8, Rgb16, Rgba8};
    photographs("PNG", [Rgb8, L8, La8, Rgba8, L16, Rgb16].map(png).to_vec(), Some(mend_png));
}

#[test]
fn fuzzed_jpegs_are_decoded_or_refused() {
    let corpus = vec![jpeg(ExtendedColorType::Rgb8), jpeg(ExtendedColorType::L8), progressive_jpeg()];
    photographs("JPEG", corpus, None);
}

#[test]
fn fuzzed_tiffs_are_decoded_or_refused() {
    photographs("TIFF", [1, 5, 8, 32_773].map(tiff).to_vec(), None);
}

#[test]
fn fuzzed_masks_are_applied_to_a_photograph_or_refused() {
    let photograph = png(ExtendedColorType::Rgb8);
    let camera = camera((WIDTH, HEIGHT));
    let read = |bytes: &[u8]| {
        let photograph = Photograph { name: "photograph", image: &photograph, mask: Some(bytes) };
        picture::prepare(&photograph, &camera, MaskKeep::Black, 64).is_ok()
    };
    let corpus = vec![png(ExtendedColorType::L8), png(ExtendedColorType::Rgba8), jpeg(ExtendedColorType::L8)];
    let target = Target::new("mask", corpus, &read);
    run(&Target { mend: Some(mend_png), extra_bytes: DECODER_BYTES, inputs: 1000, ..target });
}
