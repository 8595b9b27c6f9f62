//! Devices that run out of memory, and devices that are lost. These tests need their own process: one test
//! runs it again with so little address space that the driver itself refuses.
#![expect(clippy::unwrap_used, reason = "the helpers of a test fail by panicking")]

use std::sync::Arc;
use std::time::{Duration, Instant};

use fathom_core::CoreError;
use fathom_core::config::TrainConfig;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, GpuOptions, Renderer, device_for_test, limited_device_for_test};
use fathom_core::train::{TrainRun, Trainer};
use fathom_core::views::TrainView;
use fathom_twins::samples::{grey, off_centre_view, random};

const MIB: u64 = 1 << 20;

/// A run with room for `cap` Gaussians of SH 3.
fn run(cap: u32) -> TrainRun {
    let (camera, pose) = off_centre_view(64, 48, 3.0);
    TrainRun {
        config: TrainConfig { iterations: 1000, max_gaussians: cap, ..TrainConfig::default() },
        extent: 3.0,
        views: Arc::new(grey(vec![TrainView { name: "grey".into(), camera, pose, clear_range: 0.0 }])),
        focus: random(5, 200, 3),
        context: Gaussians::empty(3),
        surfaces: Gaussians::empty(3),
        medium: None,
        surface: None,
    }
}

fn allocated(gpu: &Gpu) -> u64 {
    gpu.memory().unwrap().allocated_bytes
}

/// Needed and available bytes of the error, which must be `OutOfMemory`.
#[track_caller]
fn needed_and_available(error: CoreError) -> (u64, u64) {
    match error {
        CoreError::OutOfMemory { needed_bytes: Some(needed), available_bytes: Some(available), .. } => {
            (needed, available)
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_memory_limit_too_small_to_be_in_bytes_is_refused() {
    let options = GpuOptions { allow_cpu: true, memory_limit: Some(8), ..GpuOptions::default() };
    let error = Gpu::new(options).err().unwrap();
    assert!(matches!(&error, CoreError::Config(message) if message.contains("it is in bytes")), "{error:?}");
}

#[test]
fn memory_is_counted_until_the_last_clone_is_dropped() {
    let Some(gpu) = device_for_test("the memory accounting") else { return };
    // Waits until wgpu has finished its own first writes.
    gpu.release_unused().unwrap();
    let before = gpu.memory().unwrap();
    assert_eq!(before.limit_bytes, None);
    assert!(before.reserved_bytes >= before.allocated_bytes);
    let buffer = gpu.buffer("measured", 10 * MIB).unwrap();
    let uniform = gpu.uniform("uniform", &[0_u32; 64]);
    gpu.release_unused().unwrap();
    let with_both = allocated(&gpu) - before.allocated_bytes;
    assert!((10 * MIB + 256..10 * MIB + 128 * 1024).contains(&with_both), "{with_both} bytes");
    assert!((10 * MIB..11 * MIB).contains(&gpu.memory_by_label().unwrap()["measured"]));

    let read: Vec<u32> = gpu.read(&buffer, 0, 2 * MIB as usize).unwrap();
    assert!(read.iter().all(|&word| word == 0));
    let memory = gpu.memory().unwrap();
    assert_eq!(
        memory.allocated_bytes,
        before.allocated_bytes + with_both,
        "a read did not release its memory"
    );
    assert!(
        memory.peak_bytes >= memory.allocated_bytes + 8 * MIB,
        "the peak does not include the read-back buffer"
    );

    let clone = buffer.clone();
    drop((buffer, uniform));
    assert!(allocated(&gpu) >= before.allocated_bytes + 10 * MIB, "a clone still exists");
    drop(clone);
    assert_eq!(allocated(&gpu), before.allocated_bytes);
    assert!(gpu.memory().unwrap().peak_bytes >= before.allocated_bytes + 18 * MIB);
    gpu.reset_peak();
    assert_eq!(gpu.memory().unwrap().peak_bytes, before.allocated_bytes);
}

#[test]
fn a_finished_run_releases_all_its_memory() {
    let Some(gpu) = device_for_test("the memory of a finished run") else { return };
    gpu.release_unused().unwrap();
    let before = allocated(&gpu);
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(10_000)).unwrap();
    trainer.advance(3).unwrap();
    let own = trainer.memory();
    assert!(allocated(&gpu) - before >= own.gaussians + own.per_visible + own.per_intersection);
    drop(trainer);
    gpu.release_unused().unwrap();
    assert_eq!(allocated(&gpu), before, "left: {:?}", gpu.memory_by_label());
}

#[test]
fn writes_are_staged_in_bounded_memory() {
    let Some(gpu) = device_for_test("the staging of writes") else { return };
    let content = vec![7_u32; 70 * MIB as usize / 4];
    let buffers = ["first", "second"].map(|label| gpu.buffer(label, 70 * MIB).unwrap());
    gpu.reset_peak();
    let before = allocated(&gpu);
    buffers.iter().for_each(|buffer| gpu.write(buffer, 0, &content));
    let peak = gpu.memory().unwrap().peak_bytes - before;
    assert!((70 * MIB..71 * MIB).contains(&peak), "{peak} bytes for writes of 70 MiB");
    for buffer in &buffers {
        let ends: [Vec<u32>; 2] = [0, 70 * MIB - 4].map(|at| gpu.read(buffer, at, 1).unwrap());
        assert_eq!(ends, [[7], [7]]);
    }
}

#[test]
fn allocation_beyond_the_limit_fails_and_the_device_survives() {
    let limit = 100 * MIB;
    let Some(gpu) = limited_device_for_test("the limit of memory", Some(limit)) else { return };
    assert_eq!(gpu.memory().unwrap().limit_bytes, Some(limit));
    let mut buffers = Vec::new();
    let error = loop {
        match gpu.buffer("many", 32 * MIB) {
            Ok(buffer) => buffers.push(buffer),
            Err(error) => break error,
        }
    };
    assert_eq!(buffers.len(), 3);
    let message = error.to_string();
    assert!(message.contains("has 100.0 MiB") && message.contains("32.0 MiB for many"), "{message}");
    assert!(message.contains("use more partitions or lower --max-gaussians"), "{message}");
    let (needed, available) = needed_and_available(error);
    assert_eq!((needed, available), (allocated(&gpu) + 32 * MIB, limit));
    assert!(gpu.memory().unwrap().peak_bytes <= limit);

    // The staging memory of reads and writes counts as well, and they fail with the same error.
    needed_and_available(gpu.read::<u32>(&buffers[0], 0, 8 * MIB as usize).unwrap_err());
    gpu.write(&buffers[0], 0, &vec![9_u32; 2 * MIB as usize]);
    needed_and_available(gpu.check().unwrap_err());
    gpu.check().unwrap();
    assert_eq!(gpu.read::<u32>(&buffers[0], 0, 4).unwrap(), [0; 4], "a refused write must not take effect");

    // A uniform cannot be refused at once; the next check reports the error.
    let rest = limit - allocated(&gpu) - MIB / 2;
    buffers.push(gpu.buffer("rest", rest).unwrap());
    let uniforms: Vec<wgpu::Buffer> = (0..9).map(|_| gpu.uniform("large", &[0_u32; 16_384])).collect();
    needed_and_available(gpu.check().unwrap_err());
    drop((buffers, uniforms));

    // A run that does not fit, then one that fits, on the same device.
    needed_and_available(Trainer::new(Arc::clone(&gpu), run(300_000)).err().unwrap());
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(300)).unwrap();
    assert!(trainer.advance(3).unwrap().loss.is_finite());
}

#[test]
fn cached_photographs_make_room_for_a_run_and_change_no_byte() {
    const SIZE: u32 = 256;
    const VIEWS: u64 = 12;
    let photographs = VIEWS * u64::from(4 * SIZE * SIZE);
    let train = |limit: Option<u64>| -> Option<(Vec<u8>, u64)> {
        let gpu = limited_device_for_test("photographs that make room", limit)?;
        let (camera, pose) = off_centre_view(SIZE, SIZE, 3.0);
        let view = TrainView { name: "grey".into(), camera, pose, clear_range: 0.0 };
        let mut run = run(300);
        run.views = Arc::new(grey(vec![view; VIEWS as usize]));
        (run.config.resolution_at, run.config.sh_degree_at) = ([0.0; 2], [0.0; 3]);
        let mut trainer = Trainer::new(Arc::clone(&gpu), run).unwrap();
        trainer.advance(2 * VIEWS as u32).unwrap();
        Some((trainer.checkpoint().unwrap(), gpu.memory().unwrap().peak_bytes))
    };
    let Some((ample, peak)) = train(None) else { return };
    let limit = peak - photographs / 2;
    let (short, short_peak) = train(Some(limit)).unwrap();
    assert!(short_peak <= limit, "{short_peak} bytes of {limit}");
    assert!(short == ample, "photographs kept on the device changed the run");
}

#[test]
fn memory_of_dropped_buffers_is_released_before_an_error() {
    let Some(gpu) = limited_device_for_test("memory that is released late", Some(100 * MIB)) else {
        return;
    };
    // The bind groups of a dropped renderer keep its buffers.
    let (camera, pose) = off_centre_view(640, 480, 3.0);
    let mut renderer = Renderer::new(Arc::clone(&gpu), &random(6, 1000, 3)).unwrap();
    renderer.render(&camera, &pose, [0.0; 3]).unwrap();
    drop(renderer);
    let kept = allocated(&gpu);
    assert!(kept > 3 * MIB, "{kept} bytes: no buffers are kept, so this test proves nothing");
    assert!(gpu.buffer("nearly all", 98 * MIB).is_ok());
}

/// The driver's own refusal, through wgpu's error scope: lavapipe finds no memory in a process with little
/// address space.
#[cfg(target_os = "linux")]
#[test]
fn a_driver_without_memory_fails_and_the_device_survives() {
    const CHILD: &str = "FATHOM_TEST_LITTLE_MEMORY";
    if std::env::var_os(CHILD).is_some() {
        return without_memory(&device_for_test("a driver without memory").unwrap());
    }
    let Some(gpu) = device_for_test("a driver without memory") else { return };
    if !gpu.adapter().is_cpu {
        // The memory of a real GPU is not in the address space of the process.
        return;
    }
    let tests = std::env::current_exe().unwrap();
    let this = "a_driver_without_memory_fails_and_the_device_survives";
    let output = std::process::Command::new("sh")
        .args(["-c", "ulimit -v 4194304 && exec \"$0\" --exact \"$1\" --nocapture"])
        .arg(tests)
        .arg(this)
        // Fixed numbers, because address space that depends on the number of cores would change the test.
        .envs([(CHILD, "1"), ("LP_NUM_THREADS", "2"), ("MALLOC_ARENA_MAX", "2")])
        .output()
        .unwrap();
    let message =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    assert!(output.status.success(), "{}: {message}", output.status);
    assert!(message.contains("the driver refused 128.0 MiB for many"), "{message}");
    assert!(message.contains("1 passed") && !message.contains("panicked"), "{message}");
}

#[cfg(target_os = "linux")]
fn without_memory(gpu: &Arc<Gpu>) {
    let content = vec![1_u32; 96 * MIB as usize / 4];
    let target = gpu.buffer("target", 96 * MIB).unwrap();
    let until_refused = |size: u64| {
        let mut buffers = Vec::new();
        loop {
            match gpu.buffer("many", size) {
                Ok(buffer) => buffers.push(buffer),
                Err(error) => return (buffers, error),
            }
            assert!(buffers.len() < 100, "no allocation was refused");
        }
    };
    let (buffers, error) = until_refused(128 * MIB);
    println!("{error}");
    let (needed, available) = needed_and_available(error);
    assert_eq!((needed, available), (allocated(gpu) + 128 * MIB, allocated(gpu)));
    assert!(available >= buffers.len() as u64 * 128 * MIB && buffers.len() > 4);
    drop(buffers);
    let mut trainer = Trainer::new(Arc::clone(gpu), run(300)).unwrap();
    assert!(trainer.advance(3).unwrap().loss.is_finite());
    drop(trainer);

    // A write loses the device when wgpu has no staging buffer for it. It must report the same error.
    let (_large, _) = until_refused(128 * MIB);
    let (_small, _) = until_refused(32 * MIB);
    gpu.write(&target, 0, &content);
    for outcome in [gpu.check(), gpu.wait(), gpu.read::<u32>(&target, 0, 1).map(drop)] {
        assert!(matches!(outcome, Err(CoreError::OutOfMemory { .. })), "{outcome:?}");
    }
}

#[test]
fn a_lost_device_is_a_typed_error_in_every_call() {
    type Case = (&'static str, fn(&Arc<Gpu>, &wgpu::Buffer, &mut Trainer) -> fathom_core::Result<()>);
    let cases: [Case; 10] = [
        ("buffer", |gpu, _, _| gpu.buffer("late", 64).map(drop).and(gpu.wait())),
        ("uniform", |gpu, _, _| {
            gpu.uniform("late", &[0_u32; 4]);
            gpu.wait()
        }),
        ("write", |gpu, buffer, _| {
            gpu.write(buffer, 0, &[1_u32; 4]);
            gpu.wait()
        }),
        ("read", |gpu, buffer, _| gpu.read::<u32>(buffer, 0, 4).map(drop)),
        ("release_unused", |gpu, _, _| gpu.release_unused()),
        ("memory", |gpu, _, _| {
            gpu.reset_peak();
            gpu.memory();
            // These calls do not wait, so the loss may be reported later.
            gpu.wait()
        }),
        ("render", |gpu, _, _| {
            let (camera, pose) = off_centre_view(64, 48, 3.0);
            let mut renderer = Renderer::new(Arc::clone(gpu), &random(7, 50, 0))?;
            renderer.render(&camera, &pose, [0.0; 3]).map(drop)
        }),
        ("advance", |_, _, trainer| trainer.advance(20).map(drop)),
        ("time_iteration", |_, _, trainer| trainer.time_iteration().map(drop)),
        ("checkpoint", |_, _, trainer| trainer.checkpoint().map(drop)),
    ];
    for warm in [false, true] {
        for (name, call) in &cases {
            let Some(gpu) = device_for_test("a lost device") else { return };
            let buffer = gpu.buffer("early", 64).unwrap();
            let mut trainer = Trainer::new(Arc::clone(&gpu), run(300)).unwrap();
            if warm {
                // Otherwise kernels are compiled on the lost device.
                trainer.advance(1).unwrap();
            }
            gpu.device().destroy();
            for _ in 0..2 {
                let outcome = call(&gpu, &buffer, &mut trainer);
                assert!(matches!(outcome, Err(CoreError::DeviceLost { .. })), "{name}: {outcome:?}");
            }
        }
    }
}

#[test]
fn losing_the_device_ends_a_run_with_an_error() {
    let Some(gpu) = device_for_test("a device lost in a run") else { return };
    let mut trainer = Trainer::new(Arc::clone(&gpu), run(300)).unwrap();
    trainer.advance(1).unwrap();
    let since = Instant::now();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(Duration::from_millis(100));
            gpu.device().destroy();
        });
        let error = loop {
            match trainer.advance(1) {
                Ok(progress) => assert!(progress.iteration < 1000, "the run ended first"),
                Err(error) => break error,
            }
            assert!(since.elapsed() < Duration::from_secs(60), "the loss was not noticed");
        };
        assert!(matches!(error, CoreError::DeviceLost { .. }), "{error:?}");
    });
    let Some(next) = device_for_test("a device after a lost one") else { return };
    assert!(Trainer::new(next, run(300)).unwrap().advance(1).unwrap().loss.is_finite());
}
