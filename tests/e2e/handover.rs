//! `fathom export` for viewing: the compressed copy of a model, and the page in one file.

use std::path::Path;

use crate::processes::{fail, succeed, under};
use fathom_core::config::Composition;
use fathom_core::gaussians::Gaussians;
use fathom_core::ply;
use fathom_core::water::{StandardErrors, Water, WaterRecord};
use serde_json::{Value, json};

/// Gaussians in a plane, each of another colour.
fn model(count: usize) -> Gaussians {
    let mut model = Gaussians::empty(0);
    for n in 0..count {
        model.means.push([n as f32 * 0.1, 0.0, 3.0]);
        model.quats.push([1.0, 0.0, 0.0, 0.0]);
        model.log_scales.push([-2.0; 3]);
        model.opacity_logits.push(4.0);
        model.sh_coeffs.push([n as f32 / count as f32, 0.0, -0.5]);
    }
    model
}

/// A result with a water in the header of its model, and its cameras.
fn write_result(out: &Path, model: &Gaussians) {
    std::fs::create_dir(out).expect("a folder");
    let water = Water { beta_d: [0.3, 0.1, 0.08], beta_b: [0.2, 0.1, 0.1], b_inf: [0.02, 0.1, 0.2] };
    let unknown = StandardErrors::default();
    let record = WaterRecord::new(&water, Composition::PixelsSrgb, unknown, "fixed", 0.0);
    let record = record.to_comment().expect("a comment");
    ply::write_model(&out.join("model.ply"), model, &[record]).expect("a model");
    std::fs::write(out.join("cameras.json"), r#"[{"img_name": "a.png"}]"#).expect("a file");
}

/// The content of the element that begins with `start`.
fn element<'a>(html: &'a str, start: &str) -> &'a str {
    let (_, rest) = html.split_once(start).unwrap_or_else(|| panic!("the page has no {start}"));
    rest.split_once("</script>").expect("an end").0
}

fn decoded(base64: &str) -> Vec<u8> {
    let digit = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        b'/' => 63,
        other => panic!("{other} is not base64"),
    };
    let digits: Vec<u32> = base64.trim_end_matches('=').bytes().map(|c| u32::from(digit(c))).collect();
    let bytes = digits.chunks(4).flat_map(|four| {
        let word = four.iter().fold(0, |word, digit| word << 6 | digit) << (6 * (4 - four.len()));
        word.to_be_bytes()[1..four.len()].to_vec()
    });
    bytes.collect()
}

#[test]
fn a_page_holds_the_compressed_model_and_its_scene() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    write_result(&folder.path().join("wreck & co"), &model(300));
    std::fs::create_dir(at("photographs")).expect("a folder");
    std::fs::write(at("photographs/a.png"), b"a picture").expect("a file");
    let (out, page) = (at("wreck & co"), at("page.html"));
    let credits = "</script><script>alert(1)</script>";
    let said = succeed(&[
        "export",
        &out,
        "--html",
        &page,
        "--credits",
        credits,
        "--photographs",
        &at("photographs"),
    ]);
    assert!(
        said.contains("page.html (300 Gaussians, model ") && said.contains("1 photograph, page "),
        "{said}"
    );

    // The same bytes as the copy alone, with the water in the header.
    let copy = at("model.compressed.ply");
    let said = succeed(&["export", &out, "-o", &copy]);
    assert!(said.contains("model.compressed.ply (300 Gaussians, "), "{said}");
    let copy = std::fs::read(&copy).expect("a copy");
    let html = std::fs::read_to_string(&page).expect("a page");
    assert_eq!(decoded(element(&html, "data-file=\"model.compressed.ply\">")), copy);
    assert!(String::from_utf8_lossy(&copy).contains("comment fathom_water {"));
    assert_eq!(decoded(element(&html, "data-file=\"photographs/0.png\">")), b"a picture");
    assert!(html.contains("<title>wreck &amp; co - Fathom</title>") && !html.contains("alert(1)</script>"));
    let scene: Value = serde_json::from_str(element(&html, "id=\"scene\">")).expect("JSON");
    assert_eq!(
        (&scene["name"], &scene["model"], &scene["credits"], &scene["photographs"]),
        (
            &json!("wreck & co"),
            &json!("model.compressed.ply"),
            &json!(credits),
            &json!({"a.png": "photographs/0.png"})
        )
    );

    // A copy becomes part of a page as it is, and the same input gives the same page.
    let again = at("again.html");
    succeed(&["export", &at("model.compressed.ply"), "--html", &again]);
    let html = std::fs::read_to_string(&again).expect("a page");
    assert_eq!(decoded(element(&html, "data-file=\"model.compressed.ply\">")), copy);
    succeed(&["export", &out, "--html", &again]);
    let before = std::fs::read(&again).expect("a page");
    succeed(&["export", &out, "--html", &again]);
    assert!(std::fs::read(&again).expect("a page") == before);
}

#[test]
fn the_form_of_a_model_follows_its_name_or_the_flag() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    let mut broken = model(3);
    broken.means[1][0] = f32::NAN;
    ply::write_model(Path::new(&at("model.ply")), &broken, &[]).expect("a model");
    let is_compressed = |name: &str| {
        String::from_utf8_lossy(&std::fs::read(at(name)).expect("a file"))
            .contains("property uint packed_position")
    };
    let said = succeed(&["export", &at("model.ply"), "-o", &at("a.compressed.ply")]);
    assert!(said.contains("(2 Gaussians, "), "{said}");
    succeed(&["export", &at("model.ply"), "-o", &at("b.ply"), "--format", "compressed-ply"]);
    succeed(&["export", &at("model.ply"), "-o", &at("c.ply")]);
    assert_eq!(["a.compressed.ply", "b.ply", "c.ply"].map(is_compressed), [true, true, false]);
    let (_, error) = fail(&["render", &at("b.ply"), "--orbit", "2", "--allow-cpu", "-o", &at("frames")]);
    assert!(error.contains("is a compressed PLY"), "{error}");
}

#[test]
fn pages_that_cannot_be_made_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| under(folder.path(), name);
    let out = at("out");
    write_result(Path::new(&out), &model(3));
    let page = at("page.html");
    let refused = |words: &[&str], expected: &[&str]| {
        let (_, error) = fail(words);
        assert!(expected.iter().all(|text| error.contains(text)), "{words:?}: {error}");
        assert!(!Path::new(&page).exists(), "{words:?}");
    };
    refused(&["export", &out], &["--output <FILE.ply>", "required"]);
    refused(&["export", &out, "--html", &at("page.txt")], &["page.txt does not end with .html"]);
    refused(&["export", &at("none"), "--html", &page], &["none is no file", "result folder"]);
    refused(
        &["export", &out, "--html", &page, "-o", &at("a.ply")],
        &["--html", "--output", "cannot be used"],
    );
    refused(&["export", &out, "--html", &page, "--frame", "aligned"], &["--frame", "cannot be used"]);
    refused(&["export", &out, "--credits", "me", "-o", &at("a.ply")], &["are for a page", "--html"]);
    refused(
        &["export", &out, "--html", &page, "--views", "http://127.0.0.1/"],
        &["holds no view", "Copy link"],
    );
    refused(
        &["export", &out, "--html", &page, "--photographs", folder.path().to_str().expect("text")],
        &["has no photograph", "cameras.json"],
    );
    refused(&["export", &out, "--html", &at("no folder/page.html")], &["no folder"]);
    succeed(&["export", &out, "--export-colour", "linear", "-o", &at("linear.ply")]);
    refused(&["export", &at("linear.ply"), "--html", &page], &["linear.ply", "linear light"]);
    std::fs::write(at("broken.ply"), "ply\n").expect("a file");
    refused(&["export", &at("broken.ply"), "--html", &page], &["broken.ply"]);
}
