#!/usr/bin/env bash
# Trains the same short jobs with two binaries and compares the models byte for byte: refactoring must not
# change them.
#
#   scripts/same_bytes.sh BASELINE_FATHOM FATHOM [CASE...]
#
# FATHOM_SAME_BYTES_OUT is the working folder (default: out/same-bytes); existing models of the baseline are
# kept. FATHOM_SCENES adds the scene `fox` of the test scenes. About 5 minutes for both binaries on 2 cores
# without a GPU.
set -euo pipefail
cd "$(dirname "$0")/.."

baseline=$1 changed=$2
shift 2
out="${FATHOM_SAME_BYTES_OUT:-out/same-bytes}"
mkdir -p "$out"
scene="$out/scene"
[ -d "$scene" ] || "$baseline" synth "$scene" --views 36 --size 120x90 --seed 5 >/dev/null
[ -d "$scene-air" ] || "$baseline" synth "$scene-air" --views 36 --size 120x90 --seed 5 --water off >/dev/null

# name, scene, further arguments
cases=(
    "air-1x1-3dgs|$scene-air|--preset 3dgs --partitions 1x1"
    "water-2x2-fathom|$scene|--partitions 2x2 --workers 2"
    "water-2x2-paper|$scene|--preset paper --partitions 2x2 --workers 2"
    "water-per-gaussian|$scene|--partitions 1x1 --set water.medium=\"per_gaussian\" --set water.blend=\"linear\""
    "exposure|$scene|--partitions 1x1 --set train.exposure=true"
    "classic|$scene|--partitions 1x1 --set train.strategy=\"classic\""
    "borders|$scene|--partitions 2x2 --workers 2 --set borders.enabled=true"
    "neighbours|$scene|--partitions 2x1 --set partition.neighbours_from=0.7"
    "refine|$scene|--partitions 2x1 --set water.partitions=\"joint\""
    "resumed|$scene|--partitions 1x1"
)
if [ -d "${FATHOM_SCENES:-/nonexistent}/fox" ]; then
    cases+=("fox-1x1-3dgs|$FATHOM_SCENES/fox|--preset 3dgs --partitions 1x1 --max-resolution 160")
fi

train() { # side, binary, folder, scene, name, arguments...
    local side=$1 binary=$2 into=$3 data=$4 name=$5 iterations=160
    shift 5
    if [ "$name" = resumed ]; then iterations=800; fi
    local command=("$binary" train "$data" -o "$into" --allow-cpu --iterations "$iterations" --max-gaussians 6000 --seed 3 "$@")
    if [ "$name" = resumed ] && [ "$side" = changed ]; then
        # The baseline is not interrupted; this one is, then resumes.
        "${command[@]}" >"$into.log" 2>&1 &
        local child=$!
        sleep "${FATHOM_SAME_BYTES_STOP_S:-8}"
        if ! kill -INT "$child" 2>/dev/null; then
            printf 'same_bytes: the run ended before it was interrupted; lower FATHOM_SAME_BYTES_STOP_S\n' >&2
            return 1
        fi
        wait "$child" || true
        command+=(--resume)
    fi
    "${command[@]}" >>"$into.log" 2>&1 || { printf 'same_bytes: %s failed; see %s.log\n' "$name" "$into" >&2; return 1; }
}

status=0
printf '%-20s %-18s %-18s %s\n' case baseline changed verdict
for entry in "${cases[@]}"; do
    IFS='|' read -r name data arguments <<<"$entry"
    if [ $# -gt 0 ] && [[ " $* " != *" $name "* ]]; then continue; fi
    digests=()
    for side in baseline changed; do
        into="$out/$side/$name"
        if [ "$side" = changed ] || [ ! -f "$into/model.ply" ]; then
            rm -rf "$into" && mkdir -p "$(dirname "$into")"
            [ "$side" = baseline ] && binary=$baseline || binary=$changed
            # The table quotes some words for a shell; remove the quotes.
            read -ra words <<<"${arguments//\"/}"
            train "$side" "$binary" "$into" "$data" "$name" "${words[@]}" || { status=1; continue 2; }
        fi
        digests+=("$(sha256sum <"$into/model.ply" | cut -c1-16)")
    done
    verdict=same
    if [ "${digests[0]}" != "${digests[1]}" ]; then verdict=DIFFERENT; status=1; fi
    printf '%-20s %-18s %-18s %s\n' "$name" "${digests[0]}" "${digests[1]}" "$verdict"
done
exit "$status"
