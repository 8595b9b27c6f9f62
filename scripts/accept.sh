#!/usr/bin/env bash
# Reruns the figures that are claimed and appends a row for each to the table in BENCHMARKS.md.
#
# The scenes are not part of the repository: FATHOM_SCENES says where they are (default ../shared/scenes). What is not
# there is reported as not checked, and the script fails only where a figure misses its bound.
# One figure: `scripts/accept.sh NAME`; the names are the functions below.
set -euo pipefail
cd "$(dirname "$0")/.."

fathom="${CARGO_TARGET_DIR:-target}/debug/fathom"
scenes="${FATHOM_SCENES:-../shared/scenes}"
out="${FATHOM_ACCEPT_OUT:-out/accept}"
failures=0
command -v python3 >/dev/null || { printf 'accept: python3 is needed to read JSON; apt-get install python3\n' >&2; exit 1; }
mkdir -p "$out"
adapter=$("$fathom" doctor --json 2>/dev/null | sed -nE 's/^ *"name": "(.*)",$/\1/p' | head -n 1)

row() { # command, figure
    printf '| %s | %s | `%s` | %s |\n' "$(date -u +%Y-%m-%d)" "$adapter" "$1" "$2" >>BENCHMARKS.md
    printf 'accept: %s: %s\n' "$1" "$2"
}
miss() {
    printf 'accept: MISSED: %s\n' "$*" >&2
    failures=$((failures + 1))
}
have() {
    [ -e "$scenes/$1" ] && return 0
    printf 'accept: %s is not there, so its figures were not checked\n' "$scenes/$1" >&2
    return 1
}
number() { # path of keys in a JSON file, such as .baselines.blur.psnr
    python3 -c 'import json, sys
value = json.load(open(sys.argv[2]))
for key in sys.argv[1].split("."):
    value = value[key] if key else value
print(value)' "$1" "$2"
}
at_least() { awk -v value="$1" -v bound="$2" 'BEGIN { exit !(value >= bound) }'; }
round() { printf '%.2f' "$1"; }

# Trains into a fresh folder; prints nothing but what goes wrong.
train() { # name of the result, arguments
    local name=$1
    shift
    rm -rf "${out:?}/$name"
    "$fathom" train "$@" -o "$out/$name" --allow-cpu >/dev/null
}

fox() {
    have fox || return 0
    local settings=(--iterations 2000 --max-gaussians 60000 --seed 1) begin=$SECONDS psnr quartered
    train fox "$scenes/fox" --partitions 1x1 "${settings[@]}"
    psnr=$(number psnr "$out/fox/metrics.json")
    row "fathom train fox --partitions 1x1 ${settings[*]}" \
        "PSNR $(round "$psnr") dB, SSIM $(number ssim "$out/fox/metrics.json" | cut -c1-6), $((SECONDS - begin)) s"
    at_least "$psnr" 27 || miss "fox 1x1 has $psnr dB, below 27"
    train fox-again "$scenes/fox" --partitions 1x1 "${settings[@]}"
    if cmp -s "$out/fox/model.ply" "$out/fox-again/model.ply"; then
        row "the same again" "the same bytes of model.ply"
    else
        miss "two runs of fox with one seed differ"
    fi
    train fox-2x2 "$scenes/fox" --partitions 2x2 --workers 2 "${settings[@]}"
    quartered=$(number psnr "$out/fox-2x2/metrics.json")
    row "fathom train fox --partitions 2x2 --workers 2 ${settings[*]}" "PSNR $(round "$quartered") dB"
    at_least "$quartered" "$(awk "BEGIN { print $psnr - 0.5 }")" || miss "fox 2x2 has $quartered dB, 1x1 has $psnr"
}

above_blur() { # scene, arguments
    local scene=$1
    shift
    have "$scene" || return 0
    local settings=("$@" --workers 2 --max-resolution 240 --iterations 6000 --max-gaussians 120000 --seed 1)
    train "$scene" "$scenes/$scene" "${settings[@]}"
    "$fathom" eval "$out/$scene" --data "$scenes/$scene" --baselines --allow-cpu --json >"$out/$scene.json" 2>/dev/null
    local psnr ssim blur blur_ssim
    psnr=$(number psnr "$out/$scene.json")
    ssim=$(number ssim "$out/$scene.json")
    blur=$(number baselines.blur.psnr "$out/$scene.json")
    blur_ssim=$(number baselines.blur.ssim "$out/$scene.json")
    row "fathom train $scene ${settings[*]}" "PSNR $(round "$psnr") dB, SSIM $(cut -c1-6 <<<"$ssim"); \
flat colour $(round "$(number baselines.flat_colour.psnr "$out/$scene.json")") dB, \
$(number baselines.flat_colour.ssim "$out/$scene.json" | cut -c1-6); \
15-pixel blur $(round "$blur") dB, $(cut -c1-6 <<<"$blur_ssim")"
    at_least "$psnr" "$blur" || miss "$scene has $psnr dB, a blur has $blur"
    at_least "$ssim" "$blur_ssim" || miss "$scene has SSIM $ssim, a blur has $blur_ssim"
}
reef() { above_blur reef-clip --partitions 1x1; }
wreck() { above_blur sesa-wreck --partitions 2x3; }

plans() {
    local scene partitions begin seconds
    for scene in "auv 4x6" "kitti 4x4" "street-cameras.json 3x3"; do
        read -r scene partitions <<<"$scene"
        have "$scene" || continue
        begin=$(date +%s.%N)
        "$fathom" inspect "$scenes/$scene" --partitions "$partitions" --plan "$out/plan-${scene%.json}.png" >/dev/null
        seconds=$(awk "BEGIN { printf \"%.2f\", $(date +%s.%N) - $begin }")
        row "fathom inspect $scene --partitions $partitions" "$seconds s"
        at_least 5 "$seconds" || miss "the plan of $scene took $seconds s"
    done
}

# The binary model is of the undistorted photographs and text_model of the originals: one reconstruction, two cameras. The
# other text model, with a camera for each image, is another reconstruction of the same photographs.
readers() {
    have sceaux || return 0
    poses() { # scene
        "$fathom" inspect "$1" --no-plan --json 2>/dev/null | python3 -c 'import json, sys
for image in json.load(sys.stdin)["images"]:
    numbers = image["world_to_camera_quat_wxyz"] + image["world_to_camera_translation"]
    print(image["name"].rsplit(".", 1)[0], *("%.5f" % n for n in numbers))'
    }
    local binary text each
    binary=$(poses "$scenes/sceaux")
    text=$(poses "$scenes/sceaux/text_model")
    each=$(poses "$scenes/sceaux/text_model_per_image_cameras")
    if [ -z "$binary" ] || [ "$binary" != "$text" ]; then
        miss "the binary and the text model of sceaux have other poses"
        return 0
    fi
    [ "$(cut -d ' ' -f 1 <<<"$binary")" = "$(cut -d ' ' -f 1 <<<"$each")" ] || miss "the third model has other images"
    row "fathom inspect sceaux, binary and text" "the same poses of $(wc -l <<<"$binary") images; the same images in the third; \
other cameras, since the binary model is of the undistorted photographs"
}

other_programs() {
    local model="$out/fox/model.ply" status=0 said
    [ -f "$model" ] || { printf 'accept: run fox first, so that there is a model to open\n' >&2; return 0; }
    said=$(scripts/splat-transform.sh "$model") || status=$?
    case $status in
        0) row "scripts/splat-transform.sh fox/model.ply" "$said" ;;
        3) ;;
        *) miss "splat-transform does not agree about $model" ;;
    esac
}

# CPU seconds a step, bytes a Gaussian and the shares of the stages.
speed() {
    local scene result
    for scene in fox sesa-wreck; do
        have "$scene" || continue
        result="$out/speed-$scene.json"
        scripts/bench.sh "$scene" >"$result" 2>/dev/null
        row "scripts/bench.sh $scene" "$(python3 -c 'import json, sys
r = json.load(open(sys.argv[1]))
shares = sorted(r["share_of_stage"].items(), key=lambda s: -s[1])[:8]
print("%.3f CPU s a step, %.3f s wall, %.0f bytes a Gaussian, PSNR %.2f dB at step %d; " % (r["cpu_seconds_per_step"],
    r["wall_seconds_per_step"], r["bytes_per_gaussian"], r["psnr"], r["iterations"])
    + ", ".join("%s %.0f %%" % (name, 100 * share) for name, share in shares))' "$result")"
    done
}

demo() {
    FATHOM_DEMO_STRICT=1 FATHOM_DEMO_OUT="$out/demo" scripts/demo.sh >"$out/demo.log" || miss "the demo failed, see $out/demo.log"
    row "make demo" "$(grep -E '^(metrics|time):' "$out/demo.log" | sed -E 's/^[a-z]+: *//' | paste -sd ';')"
}

for figure in ${1:-plans readers demo fox other_programs speed reef wreck}; do
    "$figure"
done
if [ "$failures" -gt 0 ]; then
    printf 'accept: %d figures missed their bounds\n' "$failures" >&2
    exit 1
fi
printf 'accept: done\n'
