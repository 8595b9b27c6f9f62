#!/usr/bin/env bash
# Times of the trainer on this machine: seconds a step for a fixed scene, one worker, one partition.
# The figures that documents claim come from `make accept`; this is for comparing two versions by hand.
set -euo pipefail
cd "$(dirname "$0")/.."

fathom="${CARGO_TARGET_DIR:-target}/debug/fathom"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"$fathom" doctor
"$fathom" synth "$work/scene" 2>/dev/null
# A size for each thing that time depends on: Gaussians, pixels.
for size in "10000 240" "40000 240" "10000 120"; do
    read -r gaussians pixels <<<"$size"
    begin=$(date +%s.%N)
    "$fathom" train "$work/scene" -o "$work/$gaussians-$pixels" --iterations 300 --max-gaussians "$gaussians" \
        --max-resolution "$pixels" --allow-cpu >/dev/null 2>&1
    end=$(date +%s.%N)
    awk -v g="$gaussians" -v p="$pixels" -v s="$(awk "BEGIN { print $end - $begin }")" \
        'BEGIN { printf "%6d Gaussians, %3d pixels: %.1f s for 300 iterations and everything around them, %.0f ms each\n", g, p, s, s / 0.3 }'
done
