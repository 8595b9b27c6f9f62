#!/usr/bin/env bash
# Effect of each part of method wsgs: trains a pool once for each row, and appends the result to
# bench/history.jsonl.
#
#   scripts/surface_ablation.sh [ROW...]       rows by name; default: all
#
# FATHOM_SURFACE_ITERATIONS (default 3000) and FATHOM_ABLATION_OUT (default out/ablation) may be set. A row of
# 3000 iterations takes six minutes on two cores without a GPU.
set -euo pipefail
cd "$(dirname "$0")/.."

iterations=${FATHOM_SURFACE_ITERATIONS:-3000}
out="${FATHOM_ABLATION_OUT:-out/ablation}"
mkdir -p "$out"
cargo build --workspace --bin fathom --example train_surface
programs="$(cargo metadata --no-deps --format-version 1 | python3 -c 'import json, sys; print(json.load(sys.stdin)["target_directory"])')/debug"
pool="$out/pool"
[ -d "$pool" ] || "$programs/fathom" synth "$pool" --kind pool --size 160x120 >"$out/pool.log"

# name, arguments of the example
masked="--surface join=masked"
rows=(
    "wsgs|"
    "schlick|--surface reflectance=schlick"
    "srgb|--surface light=srgb"
    "masked|$masked"
    "masked-no-loss|$masked --surface mask_weight=0"
    "masked-paper|$masked --surface mask_weight=0.05 --surface mask_lr=0.01"
    "no-prior|--surface start=paper"
    "no-prior-trained|--surface start=paper --surface refine=offset"
    "masked-no-prior-trained|$masked --surface start=paper --surface refine=offset"
    "2dgs|--method 2dgs"
    "3dgs|--method 3dgs"
)
wanted=" ${*:-$(printf '%s\n' "${rows[@]}" | cut -d'|' -f1 | paste -sd ' ')} "
for row in "${rows[@]}"; do
    IFS='|' read -r name arguments <<<"$row"
    case "$wanted" in *" $name "*) ;; *) continue ;; esac
    # shellcheck disable=SC2086  # several words
    "$programs/examples/train_surface" "$pool" --train "iterations=$iterations" $arguments \
        >"$out/pool-$name.json" 2>"$out/pool-$name.log"
    python3 - "$out/pool-$name.json" "$name" "$arguments" <<'PYTHON'
import json
import subprocess
import sys

path, name, arguments = sys.argv[1:]
figures = json.load(open(path))
values = {key: round(figures[key], 3) for key in ("entire_db", "region_db", "dry_db", "oil_db")}
if figures["offset_error"] is not None:
    values["offset_error"] = round(figures["offset_error"], 5)
print(name, values)
command = f"train_surface POOL --train iterations={figures['iterations']} {arguments}".strip()
row = ["--figure", "surface_ablation", "--scene", "pool", "--variant", name, "--command", command]
values = [f"{key}={value}" for key, value in values.items()]
subprocess.run(["scripts/history.py", "append", *row, "--adapter", figures["adapter"], *values], check=True)
PYTHON
done
