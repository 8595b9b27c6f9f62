//! Every kernel and variant in SPIR-V, MSL and HLSL, with the options that wgpu 30 gives to naga on Vulkan,
//! Metal and DirectX 12. Also the limits of WebGPU that kernels exceed.
//!
//! No compiler of Apple or Microsoft is at hand. What is proven is that naga can write each kernel for them,
//! within the slots that they have.

use std::collections::BTreeMap;

use fathom_core::gpu::{STORAGE_BUFFERS, TileLayout, kernel_names, kernel_variants, shader_source};
use naga::back::{hlsl, msl, spv};
use naga::proc::{BoundsCheckPolicies, BoundsCheckPolicy};
use naga::valid::{Capabilities, ModuleInfo, ValidationFlags, Validator};
use naga::{AddressSpace, Module, ResourceBinding, ShaderStage, StorageAccess};

/// A kernel for one layout of tiles.
struct Kernel {
    name: String,
    layout: TileLayout,
    module: Module,
    info: ModuleInfo,
}

impl Kernel {
    fn needs_subgroups(&self) -> bool {
        self.layout.needs_subgroups() || self.name.ends_with("_subgroups")
    }
}

/// All kernels for all layouts.
fn kernels() -> Vec<Kernel> {
    let mut kernels = Vec::new();
    for name in kernel_names().chain(kernel_variants()) {
        for layout in TileLayout::ALL {
            let source = shader_source(name, layout).unwrap_or_else(|error| panic!("{name}: {error}"));
            let module = naga::front::wgsl::parse_str(&source)
                .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(&source)));
            let capabilities = Capabilities::SUBGROUP | Capabilities::SUBGROUP_BARRIER;
            let info = Validator::new(ValidationFlags::all(), capabilities)
                .validate(&module)
                .unwrap_or_else(|error| panic!("{name}: {}", error.emit_to_string(&source)));
            kernels.push(Kernel { name: name.to_owned(), layout, module, info });
        }
    }
    assert!(kernels.len() > 200, "only {} kernels were found", kernels.len());
    kernels
}

/// The bindings of a kernel, and whether it writes them.
fn bindings(module: &Module) -> impl Iterator<Item = (ResourceBinding, AddressSpace)> {
    module.global_variables.iter().filter_map(|(_, variable)| Some((variable.binding?, variable.space)))
}

fn writes(space: AddressSpace) -> bool {
    matches!(space, AddressSpace::Storage { access } if access.contains(StorageAccess::STORE))
}

/// How wgpu checks indices, with and without `GpuOptions::shader_checks`.
fn policies(checked: bool) -> BoundsCheckPolicies {
    let policy = if checked { BoundsCheckPolicy::Restrict } else { BoundsCheckPolicy::Unchecked };
    BoundsCheckPolicies {
        index: policy,
        buffer: policy,
        image_load: policy,
        binding_array: BoundsCheckPolicy::Unchecked,
    }
}

#[test]
fn kernels_translate_to_spir_v() {
    use spv::Capability;
    let always = [Capability::Shader, Capability::Matrix];
    let of_subgroups = [
        Capability::GroupNonUniform,
        Capability::GroupNonUniformVote,
        Capability::GroupNonUniformArithmetic,
        Capability::GroupNonUniformBallot,
        Capability::GroupNonUniformShuffle,
        Capability::GroupNonUniformShuffleRelative,
        Capability::GroupNonUniformQuad,
    ];
    for kernel in kernels() {
        let subgroups = of_subgroups.iter().filter(|_| kernel.needs_subgroups());
        // Version 1.3 is that of Vulkan 1.1, the oldest with subgroups; 1.0 is that of Vulkan 1.0.
        let versions: &[(u8, u8)] =
            if kernel.needs_subgroups() { &[(1, 3), (1, 6)] } else { &[(1, 0), (1, 6)] };
        for &lang_version in versions {
            for checked in [true, false] {
                let options = spv::Options {
                    lang_version,
                    flags: spv::WriterFlags::empty(),
                    capabilities: Some(always.iter().chain(subgroups.clone()).copied().collect()),
                    bounds_check_policies: policies(checked),
                    zero_initialize_workgroup_memory: spv::ZeroInitializeWorkgroupMemoryMode::Polyfill,
                    force_loop_bounding: checked,
                    ..spv::Options::default()
                };
                let pipeline =
                    spv::PipelineOptions { shader_stage: ShaderStage::Compute, entry_point: "main".into() };
                let words = spv::write_vec(&kernel.module, &kernel.info, &options, Some(&pipeline));
                let words =
                    words.unwrap_or_else(|error| panic!("{} {:?}: {error}", kernel.name, kernel.layout));
                assert_eq!(words.first(), Some(&0x0723_0203), "{}", kernel.name);
            }
        }
    }
}

#[test]
fn kernels_translate_to_msl() {
    for kernel in kernels() {
        // One slot for each buffer in the order of bindings, then that of the sizes, as wgpu's Metal backend
        // does.
        let mut resources = msl::BindingMap::default();
        for (slot, (binding, space)) in bindings(&kernel.module).enumerate() {
            let buffer =
                Some(u8::try_from(slot).unwrap_or_else(|_| panic!("{}: {slot} buffers", kernel.name)));
            resources
                .insert(binding, msl::BindTarget { buffer, mutable: writes(space), ..Default::default() });
        }
        let sizes_buffer = u8::try_from(resources.len()).ok();
        // Metal has 31 slots for buffers.
        assert!(resources.len() < 31, "{} has {} buffers", kernel.name, resources.len());
        let resources = msl::EntryPointResources { resources, immediates_buffer: None, sizes_buffer };
        // Metal 2.1 has subgroups; 2.4 and 3.0 are those of macOS 12 and 13.
        for lang_version in [(2, 1), (2, 4), (3, 0)] {
            for checked in [true, false] {
                let options = msl::Options {
                    lang_version,
                    per_entry_point_map: BTreeMap::from([("main".to_owned(), resources.clone())]),
                    bounds_check_policies: policies(checked),
                    zero_initialize_workgroup_memory: true,
                    force_loop_bounding: checked,
                    spirv_cross_compatibility: false,
                    fake_missing_bindings: false,
                    ..msl::Options::default()
                };
                let pipeline = msl::PipelineOptions {
                    entry_point: Some((ShaderStage::Compute, "main".to_owned())),
                    vertex_pulling_transform: true,
                    ..msl::PipelineOptions::default()
                };
                let (source, info) = msl::write_string(&kernel.module, &kernel.info, &options, &pipeline)
                    .unwrap_or_else(|error| panic!("{} {:?}: {error}", kernel.name, kernel.layout));
                assert!(source.contains("kernel void"), "{}", kernel.name);
                let names = info.entry_point_names;
                assert!(names.iter().all(Result::is_ok) && names.len() == 1, "{}: {names:?}", kernel.name);
            }
        }
    }
}

#[test]
fn kernels_translate_to_hlsl() {
    for kernel in kernels() {
        let mut registers = [0_u32; 3];
        let mut binding_map = hlsl::BindingMap::default();
        for (binding, space) in bindings(&kernel.module) {
            let kind = match (space, writes(space)) {
                (AddressSpace::Uniform, _) => 0,
                (_, false) => 1,
                (_, true) => 2,
            };
            let target =
                hlsl::BindTarget { register: registers[kind], restrict_indexing: true, ..Default::default() };
            registers[kind] += 1;
            binding_map.insert(binding, target);
        }
        // 5.1 is that of FXC, which knows no subgroups; 6.0 and 6.6 are those of DXC.
        let models: &[hlsl::ShaderModel] = if kernel.needs_subgroups() {
            &[hlsl::ShaderModel::V6_0, hlsl::ShaderModel::V6_6]
        } else {
            &[hlsl::ShaderModel::V5_1, hlsl::ShaderModel::V6_0, hlsl::ShaderModel::V6_6]
        };
        for &shader_model in models {
            for checked in [true, false] {
                let options = hlsl::Options {
                    shader_model,
                    binding_map: binding_map.clone(),
                    fake_missing_bindings: false,
                    zero_initialize_workgroup_memory: true,
                    restrict_indexing: checked,
                    force_loop_bounding: checked,
                    ..hlsl::Options::default()
                };
                let pipeline =
                    hlsl::PipelineOptions { entry_point: Some((ShaderStage::Compute, "main".to_owned())) };
                let mut source = String::new();
                let written = hlsl::Writer::new(&mut source, &options, &pipeline).write(
                    &kernel.module,
                    &kernel.info,
                    None,
                );
                let written =
                    written.unwrap_or_else(|error| panic!("{} {:?}: {error}", kernel.name, kernel.layout));
                let names = written.entry_point_names;
                assert!(names.iter().all(Result::is_ok) && names.len() == 1, "{}: {names:?}", kernel.name);
                assert!(source.contains("numthreads"), "{}", kernel.name);
            }
        }
    }
}

/// What a kernel uses: storage buffers, bytes of workgroup memory, threads of a workgroup.
fn used(kernel: &Kernel) -> [u32; 3] {
    let entry = kernel.info.get_entry_point(0);
    let used = kernel.module.global_variables.iter().filter(|(handle, _)| !entry[*handle].is_empty());
    let (mut buffers, mut bytes) = (0, 0);
    for (_, variable) in used {
        match variable.space {
            AddressSpace::Storage { .. } => buffers += 1,
            AddressSpace::WorkGroup => {
                bytes += kernel.module.types[variable.ty].inner.size(kernel.module.to_ctx())
            }
            _ => {}
        }
    }
    let [x, y, z] = kernel.module.entry_points[0].workgroup_size;
    [buffers, bytes, x * y * z]
}

#[test]
fn no_kernel_needs_more_than_is_asked_for() {
    // https://www.w3.org/TR/webgpu/#limits
    const WORKGROUP_BYTES: u32 = 16_384;
    const THREADS: u32 = 256;
    let mut most = 0;
    for kernel in kernels() {
        let [buffers, bytes, threads] = used(&kernel);
        let name = format!("{} {:?}", kernel.name, kernel.layout);
        assert!(buffers <= STORAGE_BUFFERS, "{name} has {buffers} storage buffers");
        assert!(bytes <= WORKGROUP_BYTES, "{name} has {bytes} bytes of workgroup memory");
        assert!(threads <= THREADS, "{name} has {threads} threads");
        most = most.max(buffers);
    }
    assert_eq!(most, STORAGE_BUFFERS, "a device is asked for more storage buffers than any kernel has");
}
