use super::*;
use crate::gaussians::Gaussians;
use crate::rng::{Stream, uniform_at};

fn sample(count: usize, sh_degree: u8) -> Gaussians {
    let mut gaussians = Gaussians::empty(sh_degree);
    for n in 0..count {
        let value = |slot: u32| uniform_at(3, Stream::Test, n as u32, slot) * 4.0 - 2.0;
        gaussians.means.push([value(0), value(1), value(2)]);
        // Exactly unit in f32, so that normalising changes nothing.
        gaussians.quats.push([[1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0], [0.5, -0.5, 0.5, -0.5]][n % 3]);
        gaussians.log_scales.push([value(3), value(4), value(5)]);
        gaussians.opacity_logits.push(value(6));
        for k in 0..gaussians.coeffs() as u32 {
            gaussians.sh_coeffs.push([value(10 + k * 3), value(11 + k * 3), value(12 + k * 3)]);
        }
    }
    gaussians
}

/// A file with the given header and a body of floats.
fn file(header: &str, body: &[f32]) -> Vec<u8> {
    let mut bytes = header.as_bytes().to_vec();
    body.iter().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    bytes
}

fn message(bytes: &[u8]) -> String {
    from_bytes(bytes, "odd.ply").unwrap_err().to_string()
}

#[test]
fn models_of_every_degree_survive_to_the_last_bit() {
    for sh_degree in 0..=3 {
        let model = sample(7, sh_degree);
        let bytes = to_bytes(&model, &["SplatRenderMode: default".to_owned()]).unwrap();
        assert_eq!(from_bytes(&bytes, "m").unwrap(), model, "degree {sh_degree}");
    }
    let empty = Gaussians::empty(2);
    assert_eq!(from_bytes(&to_bytes(&empty, &[]).unwrap(), "m").unwrap(), empty);
}

#[test]
fn header_and_rows_have_the_order_of_the_reference() {
    let mut model = sample(1, 1);
    model.means = vec![[1.0, 2.0, 3.0]];
    model.sh_coeffs = vec![[10.0, 20.0, 30.0], [11.0, 21.0, 31.0], [12.0, 22.0, 32.0], [13.0, 23.0, 33.0]];
    model.opacity_logits = vec![4.0];
    model.log_scales = vec![[5.0, 6.0, 7.0]];
    model.quats = vec![[0.0, 0.0, -3.0, 0.0]];
    let bytes = to_bytes(&model, &["one".to_owned(), "two words".to_owned()]).unwrap();
    let body_start = bytes.len() - 26 * 4;
    let header = std::str::from_utf8(&bytes[..body_start]).unwrap();
    assert!(header.starts_with(
        "ply\nformat binary_little_endian 1.0\ncomment one\ncomment two words\nelement vertex 1\nproperty float x\n"
    ));
    assert!(header.ends_with(
        "property float f_rest_8\nproperty float opacity\nproperty float scale_0\nproperty float scale_1\n\
         property float scale_2\nproperty float rot_0\nproperty float rot_1\nproperty float rot_2\n\
         property float rot_3\nend_header\n"
    ));
    let body: Vec<f32> =
        bytes[body_start..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    let expected = [
        1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 10.0, 20.0, 30.0, 11.0, 12.0, 13.0, 21.0, 22.0, 23.0, 31.0, 32.0, 33.0,
        4.0, 5.0, 6.0, 7.0, 0.0, 0.0, -1.0, 0.0,
    ];
    assert_eq!(body, expected);
}

#[test]
fn any_order_missing_normals_and_unknown_properties_are_read() {
    let header = "ply\nformat binary_little_endian 1.0\ncomment by another program\nelement vertex 2\n\
        property float rot_3\nproperty float rot_2\nproperty float rot_1\nproperty float rot_0\n\
        property float uncertainty\nproperty float z\nproperty float y\nproperty float x\n\
        property float scale_2\nproperty float scale_1\nproperty float scale_0\nproperty float opacity\n\
        property float f_dc_2\nproperty float f_dc_1\nproperty float f_dc_0\nend_header\n";
    let body: Vec<f32> = (0..30).map(|value| value as f32).collect();
    let bytes = file(header, &body);
    let model = from_bytes(&bytes, "m").unwrap();
    assert_eq!(model.sh_degree, 0);
    assert_eq!(model.means, [[7.0, 6.0, 5.0], [22.0, 21.0, 20.0]]);
    assert_eq!(model.quats[0], [3.0, 2.0, 1.0, 0.0]);
    assert_eq!(model.log_scales[0], [10.0, 9.0, 8.0]);
    assert_eq!(model.opacity_logits, [11.0, 26.0]);
    assert_eq!(model.sh_coeffs[1], [29.0, 28.0, 27.0]);
    let mut reader = SplatReader::from_bytes(&bytes, "m").unwrap();
    assert_eq!(reader.comments(), ["by another program"]);
    // Rows are returned in the layout of the writer, ready to be copied.
    let row = reader.next_row().unwrap().unwrap();
    assert_eq!((row.index, row.position, row.bytes.len()), (0, [7.0, 6.0, 5.0], 17 * 4));
    let mut writer = SplatWriter::new(Vec::new(), "copy", 2, 0, &[]).unwrap();
    writer.write_row(row.bytes).unwrap();
    while let Some(row) = reader.next_row().unwrap() {
        writer.write_row(row.bytes).unwrap();
    }
    assert_eq!(from_bytes(&writer.finish().unwrap(), "copy").unwrap().means, model.means);
}

#[test]
fn blocks_are_bounded_and_give_every_gaussian_once() {
    let model = sample(10, 1);
    let bytes = to_bytes(&model, &[]).unwrap();
    let mut reader = SplatReader::from_bytes(&bytes, "m").unwrap();
    let mut read = Gaussians::empty(1);
    let mut sizes = Vec::new();
    while let Some(block) = reader.next_block(4).unwrap() {
        sizes.push(block.len());
        (0..block.len()).for_each(|index| read.push_from(&block, index));
    }
    assert_eq!(sizes, [4, 4, 2]);
    assert_eq!(read, model);
}

#[test]
fn a_truncated_model_is_refused_by_name_and_place() {
    let bytes = to_bytes(&sample(3, 0), &[]).unwrap();
    let refused = message(&bytes[..bytes.len() - 1]);
    assert!(refused.contains("odd.ply"), "{refused}");
    assert!(refused.contains("inside Gaussian 2"), "{refused}");
    // The length of a stream cannot be checked first: the message names the incomplete row and its offset.
    let mut reader = SplatReader::new(&bytes[..bytes.len() - 69], "stream").unwrap();
    reader.next_row().unwrap();
    let refused = reader.next_row().unwrap_err().to_string();
    assert!(refused.contains(&format!("byte {}", bytes.len() - 2 * 68)), "{refused}");
    assert!(refused.contains("Gaussian 1 of 3"), "{refused}");
    for len in 0..bytes.len() {
        assert!(from_bytes(&bytes[..len], "odd.ply").is_err(), "{len} bytes passed");
    }
}

#[test]
fn an_absurd_count_allocates_nothing() {
    let bytes = to_bytes(&sample(1, 0), &[]).unwrap();
    let text = String::from_utf8_lossy(&bytes).into_owned();
    for count in ["18446744073709551615", "100000000000"] {
        let header = text.replace("element vertex 1\n", &format!("element vertex {count}\n"));
        let header = &header[..header.find("end_header\n").unwrap() + 11];
        assert!(message(&file(header, &[0.0; 17])).contains(count));
    }
}

#[test]
fn files_that_are_no_splat_models_are_refused_with_the_reason() {
    let head = "ply\nformat binary_little_endian 1.0\n";
    for (header, reason) in [
        ("solid\n", "not a PLY file"),
        ("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "no property \"x\""),
        ("ply\nformat binary_middle_endian 1.0\n", "unknown format"),
        (&format!("{head}element vertex 1\nproperty float x\nend_header\n"), "no property \"y\""),
        (&format!("{head}element vertex 1\nproperty list uchar int v\nend_header\n"), "list"),
        (
            &format!("{head}element chunk 1\nproperty float min_x\nelement vertex 1\nend_header\n"),
            "compressed",
        ),
        (&format!("{head}element vertex 1\nproperty float f_rest_0\nend_header\n"), "1 f_rest"),
        (&format!("{head}element vertex many\nend_header\n"), "line 3"),
        (&format!("{head}property float x\nend_header\n"), "without an element"),
        (&format!("{head}element vertex 1\nproperty half x\nend_header\n"), "unknown type"),
        (&format!("{head}element vertex 1\nproperty float x\n"), "without \"end_header\""),
    ] {
        let refused = message(header.as_bytes());
        assert!(refused.contains(reason), "{header:?} gave {refused}");
    }
}

/// The model of the canonical file `bytes`, with its body in another format: `write` writes each row.
fn reformatted(bytes: &[u8], format: &str, write: impl Fn(&[f32], &mut Vec<u8>)) -> Vec<u8> {
    let mut reader = SplatReader::from_bytes(bytes, "m").unwrap();
    let text = String::from_utf8_lossy(bytes);
    let end = text.find("end_header\n").unwrap() + "end_header\n".len();
    let mut other = text[..end].replace("binary_little_endian", format).into_bytes();
    while let Some(row) = reader.next_row().unwrap() {
        let row: Vec<f32> =
            row.bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        write(&row, &mut other);
    }
    other
}

#[test]
fn text_and_the_other_byte_order_give_the_same_model() {
    for sh_degree in [0, 3] {
        let model = sample(5, sh_degree);
        let bytes = to_bytes(&model, &["a comment".to_owned()]).unwrap();
        let big = reformatted(&bytes, "binary_big_endian", |row, out| {
            row.iter().for_each(|value| out.extend_from_slice(&value.to_be_bytes()));
        });
        assert_eq!(from_bytes(&big, "m").unwrap(), model, "big-endian, degree {sh_degree}");
        // Rust writes the shortest text that gives the same bits. The lines end as on Windows, with two
        // bytes.
        let text = reformatted(&bytes, "ascii", |row, out| {
            let words: Vec<String> = row.iter().map(f32::to_string).collect();
            out.extend_from_slice(format!("{}\r\n", words.join(" ")).as_bytes());
        });
        assert_eq!(from_bytes(&text, "m").unwrap(), model, "text, degree {sh_degree}");
        // The last line may lack its line end.
        assert_eq!(from_bytes(&text[..text.len() - 2], "m").unwrap(), model);
        assert!(message(&big[..big.len() - 1]).contains("inside Gaussian 4"));
    }
}

#[test]
fn invalid_rows_are_refused_by_number() {
    let bytes = to_bytes(&sample(2, 0), &[]).unwrap();
    let text = reformatted(&bytes, "ascii", |row, out| {
        out.extend_from_slice("1 ".repeat(row.len()).as_bytes());
        out.push(b'\n');
    });
    let text = String::from_utf8(text).unwrap();
    assert!(from_bytes(text.as_bytes(), "m").is_ok());
    let last = text.trim_end().rfind('\n').unwrap() + 1;
    for (line, reason) in [
        ("", "has 0 numbers instead of 17"),
        ("1 2 3", "has 3 numbers instead of 17"),
        ("1 2 x", "\"x\" is not a number"),
        (&"1 ".repeat(18), "has 18 numbers"),
        (&"1".repeat(5000), "too long"),
    ] {
        let refused = message(format!("{}{line}", &text[..last]).as_bytes());
        assert!(refused.contains("Gaussian 1 of 2") && refused.contains(reason), "{line:?} gave {refused}");
    }
}

#[test]
fn other_formats_are_named_with_a_converter() {
    for name in ["a.splat", "b.SPZ", "dir.x/c.ksplat", "d.sog"] {
        let refused = from_bytes(&[0x1F, 0x8B, 8, 0], name).unwrap_err().to_string();
        let format = name.rsplit('.').next().unwrap().to_lowercase();
        assert!(refused.contains(&format!("is a .{format} file")), "{refused}");
        assert!(refused.contains(&format!("IN.{format} OUT.ply")), "{refused}");
    }
    // A PLY with another extension is still a PLY.
    let bytes = to_bytes(&sample(1, 0), &[]).unwrap();
    assert!(from_bytes(&bytes, "model.splat").is_ok());
}

#[test]
fn a_writer_refuses_another_degree_and_another_count() {
    let mut writer = SplatWriter::new(Vec::new(), "out.ply", 2, 0, &[]).unwrap();
    assert!(writer.write(&sample(1, 1)).unwrap_err().to_string().contains("degree 1"));
    writer.write(&sample(1, 0)).unwrap();
    assert!(writer.finish().unwrap_err().to_string().contains("2 Gaussians were announced, 1 written"));
    assert!(to_bytes(&sample(1, 0), &["two\nlines".to_owned()]).is_err());
}

#[test]
fn a_file_appears_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ply");
    let model = sample(5, 3);
    write_model(&path, &model, &[]).unwrap();
    assert_eq!(read_model(&path).unwrap(), model);
    let failed = write_whole(&path, |file| {
        file.write_all(b"half").unwrap();
        Err(crate::CoreError::Scene("the disk is gone".to_owned()))
    });
    assert!(failed.is_err());
    assert_eq!(read_model(&path).unwrap(), model);
    let names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names, ["model.ply"]);
    let nowhere = folder.path().join("no such folder").join("model.ply");
    assert!(write_model(&nowhere, &model, &[]).unwrap_err().to_string().contains("no such folder"));
}

#[test]
fn quaternions_that_cannot_be_normalised_stay() {
    let mut model = sample(2, 0);
    model.quats = vec![[0.0; 4], [2.0, 0.0, 0.0, 0.0]];
    let read = from_bytes(&to_bytes(&model, &[]).unwrap(), "m").unwrap();
    assert_eq!(read.quats, [[0.0; 4], [1.0, 0.0, 0.0, 0.0]]);
}

#[test]
fn a_header_says_whether_the_mip_splatting_filter_is_used() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ply");
    for (comments, filtered) in
        [(vec![], false), (vec!["antialiased".to_owned()], false), (vec![ANTIALIASED.to_owned()], true)]
    {
        write_model(&path, &sample(3, 1), &comments).unwrap();
        assert_eq!(drawing(&path).unwrap().mip_filter, filtered, "{comments:?}");
    }
    std::fs::remove_file(&path).unwrap();
    assert!(drawing(&path).is_err());
}
