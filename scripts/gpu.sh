#!/usr/bin/env bash
# Measures Fathom on a machine with a GPU that has neither Rust nor a network.
#
#     scripts/gpu.sh pack [ARCHIVE]      here: makes the archive (default out/gpu/fathom-gpu.tar.xz)
#     tar -xf fathom-gpu.tar.xz          there
#     fathom-gpu/run                     there: checks, then times; a second call does what is left
#     scripts/gpu.sh unpack RESULTS      here: adds the rows to bench/history.jsonl and bench/gpu.md
#
# docs/internals/gpu-kit.md has the parts, their results and what the machine needs.
#
# FATHOM_SCENES         folder of the real scenes, packed if they are there (default ../shared/scenes)
# PEERS                 peers whose sources are fetched and packed (default "vksplat gsplat"; empty: none)
# FATHOM_GPU_REHEARSAL  1 packs the development build with tiny sizes, to try all of this on a CPU driver
# FATHOM_GPU_PROGRAMS   a folder of programs that are built already
set -euo pipefail
cd "$(dirname "$0")/.."
# ldconfig is not on the PATH of every user.
PATH=$PATH:/usr/sbin:/sbin

MOST_MIB=50
GLIBC=2.36
rehearsal="${FATHOM_GPU_REHEARSAL:-}"
scenes="${FATHOM_SCENES:-../shared/scenes}"
peers="${PEERS-vksplat gsplat}"
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")

say() { printf 'gpu: %s\n' "$*" >&2; }
fail() {
    say "$*"
    exit 1
}

PROGRAMS=(fathom bench_random train_scene first_iteration kernels device)

# Builds the programs and copies them, stripped, into a folder.
programs() {
    local into=$1 program name
    if [ -n "${FATHOM_GPU_PROGRAMS:-}" ]; then
        (cd "$FATHOM_GPU_PROGRAMS" && cp -L "${PROGRAMS[@]}" "$into/")
    else
        build "$into"
    fi
    strip "$into"/*
    for program in "$into"/*; do
        name=$(readelf --version-info --wide "$program" | grep -oE 'GLIBC_[0-9.]+' | cut -d_ -f2 | sort -V | tail -n 1)
        [ "$(printf '%s\n%s\n' "$name" "$GLIBC" | sort -V | tail -n 1)" = "$GLIBC" ] ||
            fail "$(basename "$program") needs glibc $name, newer than $GLIBC; build on an older system"
    done
}

build() {
    local into=$1 profile=debug flags=() program name
    if [ -z "$rehearsal" ]; then
        profile=release flags=(--release --locked)
    fi
    cargo build --workspace "${flags[@]}" --bin fathom --example bench_random --example train_scene --example first_iteration
    for name in fathom examples/bench_random examples/train_scene examples/first_iteration; do
        cp "$target/$profile/$name" "$into/"
    done
    for name in kernels device; do
        program=$(cargo test --workspace "${flags[@]}" --test "$name" --no-run --message-format=json \
            | sed -nE "s/.*\"name\":\"$name\".*\"executable\":\"([^\"]+)\".*/\1/p" | tail -n 1)
        [ -x "$program" ] || fail "the test program $name does not build"
        cp "$program" "$into/$name"
    done
}

# The Vulkan loader, and libraries that NVIDIA's driver needs. They are used where the machine lacks them.
loader() {
    local into=$1 name file
    for name in libvulkan.so.1 libX11.so.6 libXext.so.6 libxcb.so.1 libXau.so.6 libXdmcp.so.6 libbsd.so.0 libmd.so.0; do
        file=$(ldconfig -p | sed -nE "s/^\s+${name//./\\.} .*=> (.*)/\1/p" | head -n 1)
        [ -z "$file" ] || cp -L "$file" "$into/$name"
    done
    [ -e "$into/libvulkan.so.1" ] || fail "there is no Vulkan loader to pack; run scripts/setup.sh"
}

layer() {
    local from
    scripts/drivers.sh fetch >/dev/null 2>&1 || true
    for from in /usr/lib/chromium "$target/drivers/usr/lib/chromium"; do
        if [ -e "$from/libVkLayer_khronos_validation.so" ]; then
            cp "$from/libVkLayer_khronos_validation.so" "$1/"
            strip --strip-unneeded "$1"/*.so
            return
        fi
    done
    say "the validation layer is not at hand, so its check will fail there"
}

# Sizes of a run. On a GPU: those that peers publish. `points_per_view` gives over a million points.
settings() {
    local sizes='"repeats": 20, "entries": "1000000,4000000", "short_iterations": 3000,
  "stages": {"1m": [1000000, 1920, 1080], "3m": [3000000, 1920, 1080]},
  "fox": {"iterations": 12000, "max_gaussians": 300000, "max_resolution": 1920, "minute": 60},
  "wreck": {"iterations": 12000, "max_gaussians": 300000, "max_resolution": 1920},
  "mcmc": {"steps": 3000, "cap": 1000000, "views": 48, "size": "1184x888", "points_per_view": 40000}'
    if [ -n "$rehearsal" ]; then
        sizes='"repeats": 1, "entries": "1000", "short_iterations": 40,
  "kernels_filter": ["scan::"], "device_filter": ["memory_is_counted"],
  "stages": {"1m": [2000, 96, 54], "3m": [3000, 96, 54]},
  "fox": {"iterations": 20, "max_gaussians": 2000, "max_resolution": 64, "minute": 1},
  "wreck": {"iterations": 20, "max_gaussians": 2000, "max_resolution": 64},
  "mcmc": {"steps": 20, "cap": 2000, "views": 10, "size": "64x48", "points_per_view": 400}'
    fi
    cat <<JSON
{ "version": "$(sed -nE 's/^version = "(.*)"/\1/p' Cargo.toml | head -n 1)",
  "commit": "$(git rev-parse --short HEAD 2>/dev/null || echo unknown)$([ -z "$(git status --porcelain --untracked-files=no 2>/dev/null)" ] || echo +changes)",
  "rehearsal": $([ -n "$rehearsal" ] && echo true || echo false),
  "allowed_messages": [$(sed -nE 's/^ *\[([A-Za-z0-9-]+)\]=.*/"\1"/p' scripts/drivers.sh | paste -sd ,)],
  $sizes }
JSON
}

pack() {
    local archive folder peer
    archive=$(realpath -m "${1:-out/gpu/fathom-gpu.tar.xz}")
    work=$(mktemp -d)
    trap 'rm -rf "$work"' EXIT
    folder=$work/fathom-gpu
    mkdir -p "$folder"/{bin,lib,layer,scenes,peers} "$(dirname "$archive")"
    programs "$folder/bin"
    loader "$folder/lib"
    layer "$folder/layer"
    settings >"$folder/kit.json"
    cp scripts/gpu/kit.py "$folder/"
    printf '%s\n' '#!/bin/sh' 'command -v python3 >/dev/null || { echo "run: python3 is needed" >&2; exit 1; }' \
        'exec python3 "$(dirname "$(readlink -f "$0")")/kit.py" "$@"' >"$folder/run"
    chmod +x "$folder/run"
    cp LICENSE-APACHE LICENSE-MIT "$folder/"
    # What the checks compare with: one iteration on this machine's CPU driver.
    "$folder/bin/first_iteration" write "$folder/first.bin" >/dev/null
    for scene in fox sesa-wreck; do
        if [ -z "$rehearsal" ] && [ -d "$scenes/$scene" ]; then
            cp -rL --no-preserve=mode "$scenes/$scene" "$folder/scenes/"
        else
            say "$scene is not packed"
        fi
    done
    cp scripts/peers/*.py scripts/peers/*.sh "$folder/peers/"
    for peer in $peers; do
        scripts/peers/"$peer".sh pack "$folder/peers/$peer" || say "$peer is not packed"
    done
    local size level=9
    [ -z "$rehearsal" ] || level=0
    tar --sort=name --owner=0 --group=0 --numeric-owner -C "$work" -c fathom-gpu | xz -T0 -"$level" >"$archive.part"
    size=$(($(stat -c %s "$archive.part") / 1048576))
    [ -n "$rehearsal" ] || [ "$size" -lt "$MOST_MIB" ] || fail "the archive has $size MiB, more than $MOST_MIB: $archive.part"
    mv "$archive.part" "$archive"
    say "$archive: $size MiB"
}

case "${1:-}" in
    pack) pack "${2:-}" ;;
    unpack)
        [ -n "${2:-}" ] || fail "usage: scripts/gpu.sh unpack RESULTS, the folder with rows.jsonl"
        python3 scripts/history.py merge "$2"
        ;;
    *)
        sed -n '2,14p' "$0" | sed 's/^# \{0,1\}//'
        exit 2
        ;;
esac
