#!/usr/bin/env bash
# Builds the published trainer VkSplat (Apache-2.0), which scripts/peers/vksplat.py runs beside ours.
#
#     scripts/peers/vksplat.sh build [--native]       with the SPIR-V that VkSplat ships, for real GPUs
#     scripts/peers/vksplat.sh build --fallback       with its shaders compiled for lavapipe, a CPU driver
#     scripts/peers/vksplat.sh pack FOLDER            copies what a build elsewhere needs: FOLDER/source for
#                                                     VKSPLAT_SOURCE, FOLDER/include for both headers
#
# The result goes to PEERS_OUT (default: target/peers/vksplat). Its folder `source` is the patched copy.
#
# VKSPLAT_SOURCE   a checkout at COMMIT; otherwise it is cloned
# VULKAN_HEADERS   folder with vulkan/vulkan.h; otherwise the system's, or Debian's package, unpacked
# GLM_HEADERS      folder with glm/glm.hpp; likewise
# SLANGC           the Slang compiler; otherwise that of the PATH, or of the Python package slangtorch
#                  (--fallback only)
# SUBGROUP_SIZE    lanes of lavapipe's subgroups, 8 or 16 (--fallback only). Default 8, vectors of 256 bits
#
# Nothing is fetched that is there. Python packages that python3 lacks go to a virtual environment in
# PEERS_OUT.
set -euo pipefail

COMMIT=41cff93b79145dec314488d4313bc3a6d737038b
root=$(realpath "$(dirname "${BASH_SOURCE[0]}")/../..")
out=$(realpath -m "${PEERS_OUT:-$root/target/peers/vksplat}")
lanes=${SUBGROUP_SIZE:-8}

say() { printf 'vksplat: %s\n' "$*" >&2; }
stop() { say "$@"; exit 1; }

# Finds its sources, or clones them.
find_sources() {
    local have
    from=${VKSPLAT_SOURCE:-}
    if [ -z "$from" ]; then
        from=$out/clone
        if [ ! -e "$from/.git" ]; then
            say "cloning VkSplat"
            git clone --quiet https://github.com/harry7557558/vksplat "$from" ||
                stop "cannot clone it; set VKSPLAT_SOURCE to a checkout at $COMMIT"
        fi
        git -C "$from" checkout --quiet --force "$COMMIT"
    fi
    [ -e "$from/vksplat/src/gs_trainer.cpp" ] || stop "$from is not a checkout of VkSplat"
    # A copy without .git may come from anywhere; the patches below fail on other sources.
    have=$(git -C "$from" rev-parse --quiet --verify HEAD 2>/dev/null || echo unknown)
    if [ -e "$from/.git" ] && [ "$have" != "$COMMIT" ]; then
        stop "$from is at $have, not at $COMMIT"
    fi
}

# A copy of its sources, without what an earlier build left there.
copy_sources() { # folder
    rm -rf "$1"
    mkdir -p "$1"
    cp -r "$from/vksplat" "$from/compile_shaders.py" "$from/LICENSE" "$1/"
    chmod -R u+w "$1"
}

# A Python with the packages that the build and vksplat.py need.
python_with_packages() {
    local need='import pybind11, numpy, cv2'
    if python3 -c "$need" 2>/dev/null; then
        python=$(python3 -c 'import sys; print(sys.executable)')
        return
    fi
    python=$out/venv/bin/python
    if ! "$python" -c "$need" 2>/dev/null; then
        say "installing pybind11, numpy and opencv-python-headless in $out/venv"
        python3 -m venv "$out/venv"
        "$python" -m pip install --quiet --disable-pip-version-check pybind11 numpy opencv-python-headless ||
            stop "pip cannot install them; install them for python3"
    fi
}

# The folder with a header: the given one, the system's, or that of Debian's package.
headers() { # header, given folder, its variable, Debian's package
    local header=$1 given=$2 variable=$3 package=$4 folder
    for folder in ${given:+"$given"} /usr/include /usr/local/include "$out/headers/usr/include"; do
        if [ -e "$folder/$header" ]; then
            printf '%s' "$folder"
            return
        fi
        [ "$folder" != "$given" ] || stop "$variable=$given has no $header"
    done
    say "fetching $package for $header"
    mkdir -p "$out/headers"
    (cd "$out/headers" && apt-get download -qq "$package" >/dev/null 2>&1 &&
        dpkg-deb -x "$package"_*.deb .) ||
        stop "there is no $header; set $variable to a folder that has it, or install $package"
    printf '%s' "$out/headers/usr/include"
}

# Replaces one line of a source; the line must be there once, or the sources are others.
patch_line() { # file, fixed string in it, replacement of this string
    local file=$out/source/vksplat/$1
    "$python" - "$file" "$2" "$3" <<'PYTHON' || stop "$file is not that of $COMMIT"
import sys
path, old, new = sys.argv[1:]
text = open(path, encoding="utf-8").read()
sys.exit("not once: " + old) if text.count(old) != 1 else None
open(path, "w", encoding="utf-8").write(text.replace(old, new))
PYTHON
}

# Changes for every device. None affects the cost of a step.
patches() {
    # Its checks, such as whether a pipeline was created, do nothing; the program would crash later. With them
    # comes a limit of about a second for a step, which is too little for some devices.
    patch_line src/config.h '#define ENABLE_ASSERTION 0' '#define ENABLE_ASSERTION 1'
    patch_line src/gs_pipeline.cpp 'kTimeout = 0x100000000ull' 'kTimeout = 0x10000000000ull'
    patch_line src/gs_pipeline.cpp '_THROW_ERROR("Failed to create compute pipeline")' \
        '_THROW_ERROR("Failed to create compute pipeline " + spirv_path)'
    # Its steps between two degrees of the harmonics are a constant; a run of 600 steps would have none.
    patch_line src/python_bindings.cpp 'const int kShDegreeInterval = 1000;' \
        'const char* sh = getenv("VKSPLAT_SH_INTERVAL"); const int kShDegreeInterval = sh ? atoi(sh) : 1000;'
    # It forgets the last pictures if their number is a multiple of twice the cores.
    patch_line src/gs_trainer.cpp 'size_t i = (numImages / batchSize) * batchSize;' \
        'size_t i = ((numImages - 1) / batchSize) * batchSize;'
}

# Changes for subgroups of fewer than 32 lanes, which its code supports only in part, and for a CPU.
fallback_patches() {
    # Its prefix sum scans one sum for each subgroup of a block with a single subgroup.
    patch_line src/gs_renderer.cpp 'const size_t block_0 = 1024;' \
        'const size_t block_0 = std::min(1024, SUBGROUP_SIZE*SUBGROUP_SIZE);'
    # 26 columns are loaded by the lanes of a subgroup, which go on by the size of the workgroup.
    patch_line slang/ssim.slang 'uint col = lane_id; col < SHARED_X; col += totalThreads' \
        'uint col = lane_id; col < SHARED_X; col += SUBGROUP_SIZE'
    # Its backward pass per pixel loads the next splats while other subgroups still read the last ones. GPUs
    # that use this pass rarely show it; lavapipe, which runs subgroups one after the other, always does.
    patch_line slang/alphablend_shader_bwd_per_pixel.slang \
        '// Collectively fetch per-Gaussian data from global to shared' 'GroupMemoryBarrierWithGroupSync();'
    # It polls the fence. On a CPU driver that would take a core from the driver, and count as its CPU time.
    patch_line src/gs_pipeline.cpp 'while (vkGetFenceStatus(device, fence) != VK_SUCCESS) {' \
        'while (vkWaitForFences(device, 1, &fence, VK_TRUE, UINT64_MAX) != VK_SUCCESS) {'
}

find_slangc() {
    slangc=${SLANGC:-$(command -v slangc || true)}
    if [ -z "$slangc" ]; then
        slangc=$out/slang/slangtorch/bin/slangc
        if [ ! -e "$slangc" ]; then
            say "fetching slangtorch (15 MB) for its Slang compiler"
            "$python" -m pip install --quiet --disable-pip-version-check --no-deps --target "$out/slang" \
                slangtorch==1.3.22 || stop "there is no slangc; set SLANGC"
        fi
    fi
    [ -e "$slangc" ] || stop "SLANGC=$slangc does not exist"
    [ -x "$slangc" ] || chmod +x "$slangc"
}

# Two of the three shaders of its radix sort, for subgroups of any size: there, the counters of 8 lanes would
# not fit into the shared memory. Same interface, same result.
radix_sort() {
    cat >"$out/source/radix_sort.slang" <<'SLANG'
static const uint RADIX = 256, PARTITION = 4096, THREADS = 16;
struct Uniforms { uint pass; uint count; };
layout(binding=0) RWStructuredBuffer<uint> digits;      // (8, RADIX): in passes done, its first place
layout(binding=1) RWStructuredBuffer<uint> partitions;  // (P, RADIX)

#if SPINE
[numthreads(1, 1, 1)]
void main(uint3 group : SV_GroupID, uniform Uniforms uniforms) {
    uint sum = 0;
    for (uint p = 0; p < (uniforms.count + PARTITION - 1) / PARTITION; p++) {
        uint value = partitions[RADIX * p + group.x];
        partitions[RADIX * p + group.x] = sum;
        sum += value;
    }
    if (group.x != 0)
        return;
    sum = 0;
    for (uint d = 0; d < RADIX; d++) {
        uint value = digits[RADIX * uniforms.pass + d];
        digits[RADIX * uniforms.pass + d] = sum;
        sum += value;
    }
}
#else
layout(binding=2) StructuredBuffer<uint> keys;
layout(binding=3) StructuredBuffer<uint> values;
layout(binding=4) RWStructuredBuffer<uint> sorted_keys;
layout(binding=5) RWStructuredBuffer<uint> sorted_values;
groupshared uint places[RADIX * THREADS];

// Each thread has a run of consecutive keys, so that the sort is stable without subgroups.
[numthreads(THREADS, 1, 1)]
void main(uint3 group : SV_GroupID, uint3 local : SV_GroupThreadID, uniform Uniforms uniforms) {
    uint t = local.x, shift = 8 * uniforms.pass, run = PARTITION / THREADS;
    uint begin = min(group.x * PARTITION + t * run, uniforms.count), end = min(begin + run, uniforms.count);
    for (uint d = 0; d < RADIX; d++)
        places[d * THREADS + t] = 0;
    for (uint i = begin; i < end; i++)
        places[((keys[i] >> shift) & 255) * THREADS + t]++;
    GroupMemoryBarrierWithGroupSync();
    for (uint d = t * (RADIX / THREADS); d < (t + 1) * (RADIX / THREADS); d++) {
        uint place = digits[RADIX * uniforms.pass + d] + partitions[RADIX * group.x + d];
        for (uint u = 0; u < THREADS; u++) {
            uint count = places[d * THREADS + u];
            places[d * THREADS + u] = place;
            place += count;
        }
    }
    GroupMemoryBarrierWithGroupSync();
    for (uint i = begin; i < end; i++) {
        uint key = keys[i], at = ((key >> shift) & 255) * THREADS + t, place = places[at];
        places[at] = place + 1;
        sorted_keys[place] = key;
        sorted_values[place] = values[i];
    }
}
#endif
SLANG
}

# Compiles its shaders by its own script, which calls these two in place of the compilers.
fallback_shaders() {
    find_slangc
    radix_sort
    # The compiler of slangtorch comes without spirv-opt, which -O calls. Mesa optimises the shaders.
    # Mesa 22.3 refuses OpCopyLogical of a structure with a matrix, which SPIR-V has from 1.4 on.
    cat >"$out/source/slangc" <<SCRIPT
#!/usr/bin/env bash
arguments=(-DSUBGROUP_SIZE=$lanes -DUSE_EMULATED_F32_ATOMIC=1 -profile spirv_1_3)
for word in "\$@"; do
    case "\$word" in
        -O) word=-O0 ;;
        */cumsum.slang) arguments+=(-DBLOCK_SIZE=$((lanes * lanes))) ;;
        # "power of two in [1, SUBGROUP_SIZE]"
        -DSPLAT_BATCH_SIZE=16) word=-DSPLAT_BATCH_SIZE=$lanes ;;
    esac
    arguments+=("\$word")
done
# Its script takes a warning for a failure.
said=\$("$slangc" "\${arguments[@]}" 2>&1) || { printf '%s\n' "\$said" >&2; exit 1; }
SCRIPT
    cat >"$out/source/glslc" <<SCRIPT
#!/usr/bin/env bash
for word in "\$@"; do into=\$word; done
case "\$into" in
    */upsweep.spv) exit 0 ;; # the one that it ships has no subgroup operations
    */spine.spv) spine=1 ;;
    */downsweep.spv) spine=0 ;;
    *) echo "unknown shader \$into" >&2; exit 1 ;;
esac
exec "$out/source/slangc" "$out/source/radix_sort.slang" -DSPINE=\$spine -target spirv -stage compute -O \
    -o "\$into"
SCRIPT
    chmod +x "$out/source/slangc" "$out/source/glslc"
    say "compiling its shaders for subgroups of $lanes"
    rm -f "$out"/source/vksplat/shader/generated/*.spv
    (cd "$out/source" && "$python" compile_shaders.py --force --jobs 1 --slangc "$out/source/slangc" \
        --glslc "$out/source/glslc" >"$out/shaders.log" 2>&1) ||
        stop "its shaders do not compile; see $out/shaders.log"
}

build() {
    local kind=native vulkan glm suffix objects file include
    case "${1:---native}" in
        --native) lanes=32 ;;
        --fallback) kind=fallback ;;
        *) stop "unknown option $1; use --native or --fallback" ;;
    esac
    case "$kind $lanes" in
        'native 32' | 'fallback 8' | 'fallback 16') ;;
        *) stop "SUBGROUP_SIZE=$lanes: use 8 or 16" ;;
    esac
    command -v python3 >/dev/null || stop "there is no python3"
    command -v g++ >/dev/null || stop "there is no g++; apt-get install g++"
    mkdir -p "$out"
    # vksplat.py takes this file for a complete build.
    rm -f "$out/build.json"
    find_sources
    copy_sources "$out/source"
    python_with_packages
    vulkan=$(headers vulkan/vulkan.h "${VULKAN_HEADERS:-}" VULKAN_HEADERS libvulkan-dev)
    glm=$(headers glm/glm.hpp "${GLM_HEADERS:-}" GLM_HEADERS libglm-dev)
    include=$("$python" -c 'import sysconfig; print(sysconfig.get_paths()["include"])')
    [ -e "$include/Python.h" ] || stop "there is no $include/Python.h; install the headers of $python"
    patches
    if [ "$kind" = fallback ]; then
        fallback_patches
        fallback_shaders
    fi
    # By hand: its CMake asks for X11 and a Vulkan library to link. vksplat.py loads the library instead.
    suffix=$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("EXT_SUFFIX"))')
    objects=$out/source/objects
    mkdir -p "$objects"
    for file in buffer colmap_reader knn scheduler gs_pipeline gs_renderer gs_trainer perf_timer \
        python_bindings; do
        say "compiling $file.cpp"
        # shellcheck disable=SC2046 # the paths of pybind11 are several words
        g++ -std=c++17 -O3 -fPIC -fvisibility=hidden -w -DSUBGROUP_SIZE="$lanes" \
            $("$python" -m pybind11 --includes) -isystem "$vulkan" -isystem "$glm" \
            -c "$out/source/vksplat/src/$file.cpp" -o "$objects/$file.o"
    done
    rm -f "$out"/vksplat*.so
    g++ -shared -s "$objects"/*.o -o "$out/vksplat$suffix"
    rm -rf "$out/shader"
    cp -r "$out/source/vksplat/shader" "$out/shader"
    cp "$out/source/vksplat/simple_trainer.py" "$out/source/LICENSE" "$out/"
    "$python" - "$out/build.json" "$COMMIT" "$kind" "$lanes" <<'PYTHON'
import json, sys
path, commit, kind, lanes = sys.argv[1:]
with open(path, "w", encoding="utf-8") as file:
    json.dump({"commit": commit, "kind": kind, "subgroup_size": int(lanes), "python": sys.executable}, file)
PYTHON
    say "built $out/vksplat$suffix ($kind)"
}

pack() {
    local into=${1:-} vulkan glm
    [ -n "$into" ] || stop "usage: vksplat.sh pack FOLDER"
    find_sources
    copy_sources "$into/source"
    vulkan=$(headers vulkan/vulkan.h "${VULKAN_HEADERS:-}" VULKAN_HEADERS libvulkan-dev)
    glm=$(headers glm/glm.hpp "${GLM_HEADERS:-}" GLM_HEADERS libglm-dev)
    mkdir -p "$into/include/vulkan"
    cp "$vulkan"/vulkan/*.h "$into/include/vulkan/"
    cp -r "$vulkan/vk_video" "$glm/glm" "$into/include/"
}

case "${1:-}" in
    build) build "${@:2}" ;;
    pack) pack "${@:2}" ;;
    *) sed -n '2,19p' "$0"; exit 2 ;;
esac
