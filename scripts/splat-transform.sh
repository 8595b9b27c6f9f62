#!/usr/bin/env bash
# Reads a model with an independent program, @playcanvas/splat-transform, and compares the number of
# Gaussians.
#
#     scripts/splat-transform.sh MODEL.ply
#
# Exits with 3 if npm is unreachable, so that callers can distinguish "not checked" from "wrong".
set -euo pipefail

model="${1:?usage: scripts/splat-transform.sh MODEL.ply}"
[ -f "$model" ] || { printf 'splat-transform: %s does not exist\n' "$model" >&2; exit 1; }
ours=$(head -c 4096 "$model" | LC_ALL=C sed -n 's/^element vertex \([0-9]*\).*/\1/p' | head -n 1)
if ! command -v npx >/dev/null || ! npx --yes @playcanvas/splat-transform@3.7.0 --version >/dev/null 2>&1; then
    printf 'splat-transform: npm cannot be reached, so %s was not checked\n' "$model" >&2
    exit 3
fi
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# Read and write the model: the output's header has the number of Gaussians that it read.
npx --yes @playcanvas/splat-transform@3.7.0 -q -w "$model" "$work/copy.ply"
theirs=$(head -c 4096 "$work/copy.ply" | LC_ALL=C sed -n 's/^element vertex \([0-9]*\).*/\1/p' | head -n 1)
if [ "$ours" != "$theirs" ]; then
    printf 'splat-transform: it reads %s Gaussians, the file says %s\n' "$theirs" "$ours" >&2
    exit 1
fi
printf 'splat-transform agrees: %s Gaussians\n' "$ours"
