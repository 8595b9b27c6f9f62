#!/usr/bin/env bash
# What training costs on this machine: CPU and wall seconds a step, the share of each stage, bytes a Gaussian, held-out
# quality; one JSON object a scene. CPU seconds do not depend on what else the machine does, so compare those.
#
# The synthetic scene always; fox and sesa-wreck where FATHOM_SCENES (default ../shared/scenes) has them.
# `scripts/bench.sh SCENE` runs one of them. Kernels alone: `cargo run --example bench_random`.
set -euo pipefail
cd "$(dirname "$0")/.."

scenes="${FATHOM_SCENES:-../shared/scenes}"
target="${CARGO_TARGET_DIR:-target}"
# The same packages as `make build`, so that nothing is compiled with other features.
cargo build --quiet --workspace --examples
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

bench() { # scene, folder, arguments
    printf '%s %s\n' "$1" "${*:3}" >&2
    "$target/debug/examples/train_scene" "$2" "${@:3}"
}

# Why these sizes: fox is the standard small scene of the field at its own size, sesa-wreck the common size of all
# comparisons on a CPU, the synthetic scene what everybody has. 1000 iterations see every part of the schedule.
for scene in ${1:-synth fox sesa-wreck}; do
    case $scene in
        synth)
            "$target/debug/fathom" synth "$work/scene" >/dev/null 2>&1
            bench synth "$work/scene" --iterations 1000 --max-gaussians 20000 --max-resolution 240
            ;;
        fox) [ ! -e "$scenes/fox" ] || bench fox "$scenes/fox" --iterations 1000 --max-gaussians 60000 ;;
        sesa-wreck)
            [ ! -e "$scenes/sesa-wreck" ] ||
                bench sesa-wreck "$scenes/sesa-wreck" --iterations 1000 --max-gaussians 120000 --max-resolution 240
            ;;
        *)
            printf 'bench: there is no scene %s\n' "$scene" >&2
            exit 2
            ;;
    esac
done
