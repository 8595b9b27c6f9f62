#!/usr/bin/env bash
# Takes gsplat (nerfstudio-project/gsplat, Apache-2.0) to a machine with a CUDA GPU, builds it there and runs
# gsplat_bench.py with it. That machine needs no network.
#
#     scripts/peers/gsplat.sh pack FOLDER          copy what must travel into FOLDER (1 MB as .tar.xz)
#     scripts/peers/gsplat.sh build FOLDER         build it there, on the machine with the GPU
#     scripts/peers/gsplat.sh run FOLDER ARGS...   run gsplat_bench.py with it
#
# pack takes the sources from GSPLAT_SOURCE (a checkout) or else clones them. The submodule glm comes from
# the checkout, or from GLM_SOURCE if it is empty there. fused-ssim (rahul-goel/fused-ssim, MIT), which
# gsplat's own trainer needs, comes from FUSED_SSIM_SOURCE or is cloned. Without it gsplat computes SSIM by
# plain convolutions, which is slower, and the results say so. Python is python3, or what PYTHON names.
#
# build and run exit with 3 if torch, nvcc or a CUDA GPU is missing, so that callers can distinguish "not
# measured" from "wrong". GSPLAT_ARCH=9.0 builds for that architecture without looking for a GPU.
set -euo pipefail

# Two commits after 1.6.0. It is a commit and no tag, so that everybody measures the same sources.
commit=90d7b4b349e379ccf9ee6a8cef76aa40f48bb32e
fused_ssim_commit=0ac916a05f48f8e477dc8ce1651a346b65ce2072
glm_path=gsplat/cuda/csrc/third_party/glm
python=${PYTHON:-python3}
here=$(cd "$(dirname "$0")" && pwd)

fail() { printf 'gsplat: %s\n' "$1" >&2; exit "${2:-1}"; }

# The commit of a checkout, or what a packed folder says; "unknown" for any other.
commit_of() {
    if [ -e "$1/.git" ]; then git -C "$1" rev-parse HEAD; else cat "$1/COMMIT" 2>/dev/null || printf 'unknown\n'; fi
}

clone() {
    git clone --quiet https://github.com/nerfstudio-project/gsplat.git "$1"
    git -C "$1" checkout --quiet "$commit"
    git -C "$1" submodule --quiet update --init --depth 1 "$glm_path"
}

pack() {
    local folder=$1 source=${GSPLAT_SOURCE:-} glm
    scratch=$(mktemp -d) # not local: the trap runs after this function
    trap 'rm -rf "$scratch"' EXIT
    if [ -z "$source" ]; then
        clone "$scratch/gsplat" || fail "cannot clone gsplat; set GSPLAT_SOURCE to a checkout"
        source=$scratch/gsplat
    fi
    glm=${GLM_SOURCE:-$source/$glm_path}
    [ -f "$source/gsplat/version.py" ] || fail "$source is no checkout of gsplat"
    [ -f "$glm/glm/glm.hpp" ] || fail "$glm has no glm; run git submodule update --init, or set GLM_SOURCE"
    [ ! -e "$folder/gsplat" ] || fail "$folder/gsplat exists already"
    mkdir -p "$folder/gsplat/$glm_path"
    # The package, its build script and the licences; not the tests, examples, documents and pictures.
    (cd "$source" && tar -cf - --exclude="$glm_path" --exclude=__pycache__ --exclude='*.so' \
        gsplat setup.py config.yaml LICENSE) | tar -xf - -C "$folder/gsplat"
    (cd "$glm" && tar -cf - glm copying.txt) | tar -xf - -C "$folder/gsplat/$glm_path"
    commit_of "$source" >"$folder/gsplat/COMMIT"
    local fused=${FUSED_SSIM_SOURCE:-}
    if [ -z "$fused" ] && git clone --quiet https://github.com/rahul-goel/fused-ssim "$scratch/fused-ssim"; then
        git -C "$scratch/fused-ssim" checkout --quiet "$fused_ssim_commit"
        fused=$scratch/fused-ssim
    fi
    if [ -n "$fused" ]; then
        mkdir -p "$folder/fused-ssim"
        (cd "$fused" && tar -cf - --exclude=__pycache__ \
            setup.py LICENSE ext.cpp ssim.cu ssim.h ssim3d.cu ssim3d.h fused_ssim) \
            | tar -xf - -C "$folder/fused-ssim"
        commit_of "$fused" >"$folder/fused-ssim/COMMIT"
    else
        printf 'gsplat: fused-ssim cannot be cloned; SSIM will be plain convolutions\n' >&2
    fi
    du -sh "$folder"
}

# Says what is missing, if anything.
check_machine() {
    "$python" -c 'import torch' 2>/dev/null || fail "$python has no torch" 3
    local nvcc
    nvcc=$("$python" -c 'from torch.utils.cpp_extension import CUDA_HOME as home; print(f"{home}/bin/nvcc")')
    [ -x "$nvcc" ] || fail "there is no nvcc (looked at $nvcc)" 3
    [ -n "${GSPLAT_ARCH:-}" ] && return
    "$python" -c 'import torch; raise SystemExit(not torch.cuda.is_available())' \
        || fail "there is no CUDA GPU" 3
}

build() {
    local folder=$1 arch
    [ -f "$folder/gsplat/setup.py" ] || fail "$folder was not packed"
    check_machine
    arch=${GSPLAT_ARCH:-$("$python" -c 'import torch; print("%d.%d" % torch.cuda.get_device_capability())')}
    # Only this GPU's architecture; MAX_JOBS is for ninja.
    export TORCH_CUDA_ARCH_LIST=$arch MAX_JOBS=${MAX_JOBS:-$(nproc)} CUDA_ARCHITECTURES=${arch/./}
    # Naming any module leaves out the others (2DGS, 3DGUT, losses). NUM_CHANNELS=3 compiles the rasteriser
    # for RGB alone; the default is 23 numbers of channels.
    export BUILD_3DGS=1 BUILD_ADAM=1 BUILD_RELOC=1 NUM_CHANNELS=3 BUILD_EXPERIMENTAL=0
    local start=$SECONDS fused=
    if [ -d "$folder/fused-ssim" ]; then
        (cd "$folder/fused-ssim" && "$python" setup.py build_ext --inplace) >"$folder/fused-ssim.log" 2>&1 &
        fused=$!
    fi
    # In place: nothing is installed, and no setting of the build is needed again when it runs.
    (cd "$folder/gsplat" && "$python" setup.py build_ext --inplace) >"$folder/gsplat.log" 2>&1 \
        || { tail -n 40 "$folder/gsplat.log" >&2; fail "gsplat does not build; see $folder/gsplat.log"; }
    if [ -n "$fused" ] && ! wait "$fused"; then
        tail -n 20 "$folder/fused-ssim.log" >&2
        printf 'gsplat: fused-ssim does not build; SSIM will be plain convolutions\n' >&2
    fi
    printf 'gsplat: built for %s in %d s\n' "$arch" "$((SECONDS - start))" >&2
}

run() {
    local folder
    folder=$(cd "$1" && pwd)
    shift
    "$python" -c 'import torch' 2>/dev/null || fail "$python has no torch" 3
    local path=$folder/gsplat
    # Without its compiled half fused-ssim would break gsplat's own choice between it and convolutions.
    if compgen -G "$folder/fused-ssim/fused_ssim_cuda*.so" >/dev/null; then path=$path:$folder/fused-ssim; fi
    PYTHONPATH=$path${PYTHONPATH:+:$PYTHONPATH} "$python" "$here/gsplat_bench.py" "$@"
}

main() {
    local verb=${1:-} folder=${2:-}
    [ -n "$folder" ] || fail "usage: gsplat.sh pack|build|run FOLDER [ARGS...]"
    case $verb in
        pack) pack "$folder" ;;
        build) build "$folder" ;;
        run) shift; run "$@" ;;
        *) fail "usage: gsplat.sh pack|build|run FOLDER [ARGS...]" ;;
    esac
}

main "$@"
