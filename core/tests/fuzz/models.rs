//! Models and their parts that are sent as bytes: PLY, sparse points, the state of a network.

use fathom_core::gaussians::Gaussians;
use fathom_core::nets::{RELEASE_PRIOR, WaterParamNet, WaterParamPredictor};
use fathom_core::ply;
use fathom_core::scene::{Place, Points};
use fathom_fuzz::{Folder, Target, run};

use crate::Bytes;
use crate::texts::water_record;

pub const CLOUD: &str = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty float x\nproperty float y\n\
                         property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n\
                         1 2 3 10 20 30\n-1.5 2e-1 3 255 0 0\n0 0 1 1 2 3\n";
pub const PLY_WORDS: [&str; 12] = [
    "element vertex 1000000000000\n",
    "element vertex 0\n",
    "element face 3\n",
    "property list uchar int i\n",
    "property double x\n",
    "property uchar y\n",
    "binary_big_endian",
    "binary_little_endian",
    "ascii",
    "comment fathom_water {}\n",
    "end_header\n",
    "f_rest_",
];

/// The three forms of a PLY.
pub fn clouds() -> Vec<Vec<u8>> {
    let header = |format: &str| {
        let header = format!(
            "ply\nformat {format} 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n\
             property ushort red\nproperty ushort green\nproperty ushort blue\nend_header\n"
        );
        header.into_bytes()
    };
    let row = Bytes::default().f64s(&[1.0, -2.0, 3.5]).u16(1).u16(2).u16(65_535).0;
    let big = [&[0x3f, 0xf0, 0, 0, 0, 0, 0, 0].repeat(3)[..], &[0, 1, 2, 3, 4, 5]].concat();
    vec![
        CLOUD.into(),
        [header("binary_little_endian"), row.repeat(2)].concat(),
        [header("binary_big_endian"), big.repeat(2)].concat(),
    ]
}

fn model(sh_degree: u8) -> Gaussians {
    let mut model = Gaussians::empty(sh_degree);
    for index in 0..3 {
        let value = index as f32;
        model.means.push([value, -value, 0.5]);
        model.quats.push([1.0, 0.0, 0.5, 0.0]);
        model.log_scales.push([-value; 3]);
        model.opacity_logits.push(value);
        let coeffs = model.coeffs();
        model.sh_coeffs.extend(std::iter::repeat_n([value; 3], coeffs));
    }
    model
}

#[test]
fn fuzzed_models_are_refused_or_survive_a_round_trip() {
    let comments = [water_record().to_comment().unwrap(), ply::ANTIALIASED.to_owned()];
    let mut corpus = vec![
        ply::to_bytes(&model(1), &comments).unwrap(),
        ply::to_bytes(&model(0), &[]).unwrap(),
        ply::to_bytes(&model(3), &[]).unwrap(),
    ];
    let text = String::from_utf8_lossy(&corpus[1]);
    let header = text.split_once("end_header\n").unwrap().0.replace("binary_little_endian", "ascii");
    corpus.push(
        format!("{header}end_header\n{}", "1 2 3 0 0 0 .1 .2 .3 4 -5 -5 -5 1 0 0 0\n".repeat(3)).into_bytes(),
    );
    let folder = Folder::new("model");
    let read = |bytes: &[u8]| {
        let path = folder.put("model.ply", bytes);
        // The coordinator and the renderer read the header of a model in this way.
        let (record, _) = (ply::water_record(&path), ply::drawing(&path));
        if let Ok(Some(record)) = &record {
            assert!(record.water().is_physical());
        }
        let in_memory = ply::from_bytes(bytes, "model.ply");
        let of_file = ply::read_model(&path);
        assert_eq!(in_memory.is_ok(), of_file.is_ok(), "{in_memory:?} {of_file:?}");
        let Ok(model) = in_memory else { return false };
        let mut written = ply::to_bytes(&model, &[]).unwrap();
        assert_eq!(ply::from_bytes(&written, "again").unwrap().len(), model.len());
        if !model.is_empty() {
            let rows = model.len() - 1;
            let one = model.split_where(|index| index == rows).0;
            ply::replace_rows(&mut written, "again", &[rows], &one).unwrap();
        }
        true
    };
    run(&Target { words: &PLY_WORDS, ..Target::new("Gaussian PLY", corpus, &read) });
}

#[test]
fn fuzzed_sparse_points_are_read_or_refused_and_have_one_form() {
    let mut tracked = Points::default();
    for (x, mut views) in [(1.0, vec![7, 0, 3]), (2.0, vec![]), (3.0, vec![3, 1]), (4.0, vec![])] {
        tracked.push_seen([x, 0.5, -x], [x as u8; 3], &mut views);
    }
    let mut placed = tracked.clone();
    let place = |x: f64| Place::new([x, 2.0], 8, 6);
    placed.push_seen_at([5.0; 3], [5; 3], &mut vec![(2, place(1.5)), (4, place(9.0)), (6, place(3.25))]);
    let mut plain = Points::default();
    for x in 0..5 {
        plain.push([f64::from(x), 0.5, 1.0], [9; 3]);
    }
    let read = |bytes: &[u8]| {
        let Ok(points) = Points::from_bytes(bytes) else { return false };
        assert!(points.positions.iter().flatten().all(|value| value.is_finite()));
        assert_eq!(Points::from_bytes(&points.to_bytes_with_places()).unwrap(), points);
        true
    };
    let corpus = vec![tracked.to_bytes(), placed.to_bytes_with_places(), plain.to_bytes()];
    run(&Target::new("sparse points", corpus, &read));
}

#[test]
fn a_fuzzed_state_of_a_network_is_accepted_or_refused() {
    let network = || WaterParamNet::new(8, RELEASE_PRIOR.to_raw(1.0), 7).unwrap();
    let sound = network().to_bytes();
    // Corrects the digest at the end, as an attacker who changes the content can.
    fn mend(bytes: &mut [u8]) {
        if let Some((content, digest)) = bytes.split_last_chunk_mut::<32>() {
            *digest = *blake3::hash(content).as_bytes();
        }
    }
    let cell = std::cell::RefCell::new(network());
    let read = |bytes: &[u8]| cell.borrow_mut().restore(bytes).is_ok();
    run(&Target { mend: Some(mend), ..Target::new("state of a network", vec![sound], &read) });
}
