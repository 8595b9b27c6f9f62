//! The only device of this process, and small helpers for buffers.

use std::io::Write;
use std::sync::{Arc, OnceLock};

use fathom_core::gpu::{Gpu, GpuOptions, TileLayout, device_for_test};

/// Rubbish of two kinds: large numbers as u32, and as f32 a NaN and a large negative number.
const RUBBISH: [u32; 2] = [0xDEAD_BEEF, 0x7FC0_1234];

/// The device, by [`device_for_test`]; one for all tests of this process. `FATHOM_TEST_LAYOUT=gpu` gives it
/// the tiles of a GPU, whatever it is: some limits in tests depend on the size of tiles.
pub fn device() -> Option<Arc<Gpu>> {
    static DEVICE: OnceLock<Option<Arc<Gpu>>> = OnceLock::new();
    DEVICE
        .get_or_init(|| {
            let mut gpu = device_for_test("all kernels")?;
            if std::env::var_os("FATHOM_TEST_LAYOUT").is_some_and(|layout| layout == "gpu") {
                let options = GpuOptions { allow_cpu: true, ..Default::default() };
                gpu = Gpu::with_layout(options, TileLayout::GPU).unwrap();
            }
            let adapter = gpu.adapter();
            note(&format!("kernels are tested on {} ({})", adapter.name, adapter.driver));
            Some(gpu)
        })
        .clone()
}

/// One device for each tile layout that this adapter can run: the layout of GPUs, and those of CPU adapters.
/// The last device has shaders without checks, as in a release build.
///
/// Empty where [`device`] is `None`.
pub fn layouts() -> Vec<Arc<Gpu>> {
    static DEVICES: OnceLock<Vec<Arc<Gpu>>> = OnceLock::new();
    let open = || {
        let Some(first) = device() else { return Vec::new() };
        let own = first.layout();
        let mut devices = vec![first];
        for layout in TileLayout::ALL {
            if devices.iter().any(|gpu| gpu.layout() == layout) {
                continue;
            }
            match Gpu::with_layout(GpuOptions { allow_cpu: true, ..Default::default() }, layout) {
                Ok(gpu) => devices.push(gpu),
                Err(error) => note(&format!("{layout:?} is not tested: {error}")),
            }
        }
        let options = GpuOptions { allow_cpu: true, shader_checks: Some(false), ..Default::default() };
        devices.push(Gpu::with_layout(options, own).unwrap());
        devices
    };
    DEVICES.get_or_init(open).clone()
}

fn note(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "\n{line}");
}

/// A storage buffer with content.
pub fn storage<T: bytemuck::Pod>(gpu: &Gpu, values: &[T]) -> wgpu::Buffer {
    let buffer = gpu.buffer("test", size_of_val(values) as u64).unwrap();
    gpu.write(&buffer, 0, values);
    buffer
}

/// Fills a buffer with values that spoil every result that uses them.
pub fn poison(gpu: &Gpu, buffer: &wgpu::Buffer) {
    let words: Vec<u32> = (0..buffer.size() / 4).map(|i| RUBBISH[(i % 2) as usize]).collect();
    gpu.write(buffer, 0, &words);
}

/// Asserts that two lists are bitwise equal; reports where they differ.
#[track_caller]
pub fn assert_same_bits<T: bytemuck::Pod>(what: &str, left: &[T], right: &[T]) {
    assert_eq!(left.len(), right.len(), "{what}: lengths");
    let (left, right): (&[u8], &[u8]) = (bytemuck::cast_slice(left), bytemuck::cast_slice(right));
    let differing: Vec<usize> =
        (0..left.len() / 4).filter(|i| left[4 * i..4 * i + 4] != right[4 * i..4 * i + 4]).collect();
    if let Some(&at) = differing.first() {
        let word = |bytes: &[u8]| f32::from_le_bytes(bytes[4 * at..4 * at + 4].try_into().unwrap());
        panic!(
            "{what}: {} of {} numbers differ, first number {at}: {:e} and {:e}",
            differing.len(),
            left.len() / 4,
            word(left),
            word(right)
        );
    }
}
