#!/usr/bin/env bash
# Reruns the claimed figures. Appends a row for each to bench/history.jsonl, and replaces its result in
# BENCHMARKS.md if it has one there (scripts/history.py).
#
# The scenes are not part of the repository: FATHOM_SCENES is their folder (default ../shared/scenes). A
# figure with a missing scene is reported as not checked. The script fails only if a figure misses its bound.
# One figure: `scripts/accept.sh NAME`; the names are the functions below. All figures take hours on two
# cores. FATHOM_ACCEPT_SEEDS="2 3" runs only these seeds for the figures of open water and of depth.
set -euo pipefail
cd "$(dirname "$0")/.."

target_folder() { cargo metadata --no-deps --format-version 1 | sed -E 's/.*"target_directory":"([^"]*)".*/\1/'; }
fathom="$(target_folder)/debug/fathom"
scenes="${FATHOM_SCENES:-../shared/scenes}"
out="${FATHOM_ACCEPT_OUT:-out/accept}"
failures=0
command -v python3 >/dev/null || { printf 'accept: python3 is needed to read JSON; apt-get install python3\n' >&2; exit 1; }
mkdir -p "$out"
adapter=$("$fathom" doctor --json 2>/dev/null | sed -nE 's/^ *"name": "(.*)",$/\1/p' | head -n 1)

# Records a result in the history and prints it. `current=TEXT` goes into the table of BENCHMARKS.md.
row() { # scene[/variant], command, result in words, KEY=NUMBER or KEY=[NUMBERS] or current=TEXT ...
    local scene=${1%%/*} command=$2 text=$3 options=() values=() word
    [[ $1 != */* ]] || options+=(--variant "${1#*/}")
    for word in "${@:4}"; do
        case $word in
            current=*) options+=(--current "${word#*=}") ;;
            *=) ;; # no such number in this result
            *) values+=("$word") ;;
        esac
    done
    scripts/history.py append --figure "$figure" --scene "$scene" --command "$command" --adapter "$adapter" \
        --note="$text" "${options[@]}" -- "${values[@]}"
    printf 'accept: %s: %s\n' "$command" "$text"
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
brief() { # a file with psnr and ssim
    printf '%.2f dB, %.4f' "$(number psnr "$1")" "$(number ssim "$1")"
}

# Trains into a fresh folder; prints only errors.
train() { # name of the result, arguments
    local name=$1
    shift
    rm -rf "${out:?}/$name"
    "$fathom" train "$@" -o "$out/$name" --allow-cpu >/dev/null
}

fox() {
    have fox || return 0
    local settings=(--preset 3dgs --iterations 2000 --max-gaussians 60000 --seed 1) begin=$SECONDS psnr quartered
    train fox "$scenes/fox" --partitions 1x1 "${settings[@]}"
    psnr=$(number psnr "$out/fox/metrics.json")
    row fox/1x1 "fathom train fox --partitions 1x1 ${settings[*]}" \
        "PSNR $(round "$psnr") dB, SSIM $(number ssim "$out/fox/metrics.json" | cut -c1-6), $((SECONDS - begin)) s" \
        "psnr=$psnr" "ssim=$(number ssim "$out/fox/metrics.json")" "wall_s=$((SECONDS - begin))" "current=$(brief "$out/fox/metrics.json")"
    at_least "$psnr" 28.1 || miss "fox 1x1 has $psnr dB, below 28.1"
    train fox-again "$scenes/fox" --partitions 1x1 "${settings[@]}"
    if cmp -s "$out/fox/model.ply" "$out/fox-again/model.ply"; then
        row fox/again "fathom train fox --partitions 1x1 ${settings[*]}, twice" "the same bytes of model.ply" same_bytes=1
    else
        miss "two runs of fox with one seed differ"
    fi
    train fox-2x2 "$scenes/fox" --partitions 2x2 --workers 2 "${settings[@]}"
    quartered=$(number psnr "$out/fox-2x2/metrics.json")
    row fox/2x2 "fathom train fox --partitions 2x2 --workers 2 ${settings[*]}" "PSNR $(round "$quartered") dB" \
        "psnr=$quartered" "ssim=$(number ssim "$out/fox-2x2/metrics.json")" "current=$(brief "$out/fox-2x2/metrics.json")"
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
    row "$scene" "fathom train $scene ${settings[*]}" "PSNR $(round "$psnr") dB, SSIM $(cut -c1-6 <<<"$ssim"); \
flat colour $(round "$(number baselines.flat_colour.psnr "$out/$scene.json")") dB, \
$(number baselines.flat_colour.ssim "$out/$scene.json" | cut -c1-6); \
15-pixel blur $(round "$blur") dB, $(cut -c1-6 <<<"$blur_ssim")" \
        "psnr=$psnr" "ssim=$ssim" "blur_psnr=$blur" "blur_ssim=$blur_ssim" "current=$(brief "$out/$scene.json")"
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
        row "${scene%.json}" "fathom inspect $scene --partitions $partitions" "$seconds s" "wall_s=$seconds" "current=$seconds s"
        at_least 5 "$seconds" || miss "the plan of $scene took $seconds s"
    done
}

# 100,000 cameras and 10 million points into 16x16.
plan_scale() {
    local program said
    program=$(example plan_scale fathom-plan) || { miss "plan_scale does not build"; return 0; }
    said=$("$program" | paste -sd ';' | sed 's/;/; /g') || miss "a plan of 100,000 cameras passes its bounds"
    row synthetic plan_scale "$said"
}

# Two sizes, for the slope; 100 million (14 GB of disk) with `scripts/accept.sh merge_100_million`.
merge_scale() {
    local program rows
    program=$(example merge_scale fathom-merge) || { miss "merge_scale does not build"; return 0; }
    for rows in ${1:-10_000_000 30_000_000}; do
        "$program" "$rows" >"$out/merge-$rows.log" 2>&1 || miss "a merge of $rows Gaussians: $(tail -n 1 "$out/merge-$rows.log")"
        row "$rows" "merge_scale $rows" "$(paste -sd ';' "$out/merge-$rows.log" | sed 's/;/; /g')"
    done
}
merge_100_million() { merge_scale 100_000_000; }

# Cost of partitioning: the same totals with 1 partition, 2x3 and 3x4, over three seeds; 2x3 also with the
# crop alone and with border training; and fox, which is in air, in 2x2. The bound applies to the means.
partitions() {
    local settings=(--max-resolution 240 --iterations 1000 --max-gaussians 40000) grid seed scene
    have sesa-wreck || return 0
    scene="$scenes/sesa-wreck"
    for grid in 1x1 2x3 3x4 2x3-hard 2x3-refined; do
        for seed in 1 2 3; do
            cut_run "$grid-$seed" "$scene" "$grid" "${settings[@]}" --seed "$seed"
        done
        cut_row "sesa-wreck/$grid" "fathom train sesa-wreck $(cut_arguments "$grid") ${settings[*]}, seeds 1 to 3" \
            "$out/cut-$grid"-{1,2,3}
    done
    python3 - "$out" <<'PY' || miss "a cut of sesa-wreck costs more than 0.1 dB"
import json, sys
mean = lambda grid: sum(json.load(open(f"{sys.argv[1]}/cut-{grid}-{seed}/metrics.json"))["psnr"] for seed in (1, 2, 3)) / 3
sys.exit(min(mean("2x3"), mean("3x4")) < mean("1x1") - 0.1)
PY
    have fox || return 0
    for grid in 1x1 2x2 2x2-refined; do
        cut_run "fox-$grid" "$scenes/fox" "$grid" "${settings[@]}" --preset 3dgs --seed 1
        cut_row "fox/$grid" "fathom train fox --preset 3dgs $(cut_arguments "$grid") ${settings[*]}" "$out/cut-fox-$grid"
    done
}
cut_arguments() { # grid with what is special about it
    printf '%s' "--partitions ${1%%-*} --workers 2"
    case $1 in
        *-hard) printf '%s' ' --set merge.duplicates=false' ;;
        *-refined) printf '%s' ' --set borders.enabled=true' ;;
    esac
}
cut_run() { # name, scene, grid with what is special about it, arguments
    local name=cut-$1 scene=$2 arguments TIMEFORMAT='%U %S'
    read -ra arguments <<<"$(cut_arguments "$3")"
    shift 3
    { time train "$name" "$scene" "${arguments[@]}" "$@" 2>&3; } 3>&2 2>"$out/$name.cpu"
    mv "$out/$name.cpu" "$out/$name/cpu"
}
# Prints a text line, a line for BENCHMARKS.md, then KEY=NUMBER lines: means over the results, and deviations.
cut_figures() { # results
    python3 - "$@" <<'PY'
import json, statistics, sys
metrics = [json.load(open(f"{path}/metrics.json")) for path in sys.argv[1:]]
numbers = {}
def spread(key, digits=2):
    values = [m[key] for m in metrics if m.get(key) is not None]
    if not values:
        return None
    numbers[key] = statistics.mean(values)
    if len(values) > 1:
        numbers[f"{key}_sd"] = statistics.stdev(values)
    deviation = f" +- {numbers[f'{key}_sd']:.{digits}f}" if len(values) > 1 else ""
    return f"{numbers[key]:.{digits}f}{deviation}"
brief = f"{spread('psnr')} dB, {spread('ssim', 4).split()[0]}"
parts = [f"PSNR {spread('psnr')} dB, SSIM {spread('ssim', 4)}"]
if spread("border_psnr"):
    parts.append(f"borders {spread('border_psnr')} dB, interior {spread('interior_psnr')} dB, a seam of {spread('seam_db')} dB")
    brief += f"; borders {numbers['border_psnr']:.2f}, interior {numbers['interior_psnr']:.2f} dB"
seconds = numbers["wall_s"] = statistics.mean(sum(m["seconds"].values()) for m in metrics)
minutes = numbers["cpu_min"] = statistics.mean(sum(map(float, open(f"{path}/cpu").read().split())) / 60 for path in sys.argv[1:])
print(", ".join(parts) + f", {seconds:.0f} s, {minutes:.1f} CPU minutes")
print(f"{brief}; {minutes:.1f} CPU min")
for key, value in numbers.items():
    print(f"{key}={value:.6g}")
PY
}
cut_row() { # scene/grid, command, results
    local lines
    mapfile -t lines <<<"$(cut_figures "${@:3}")"
    row "$1" "$2" "${lines[0]}" "${lines[@]:2}" "current=${lines[1]}"
}

# The binary model uses the undistorted photographs and text_model the originals: one reconstruction, two
# cameras. The other text model, with a camera per image, is another reconstruction of the same photographs.
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
    row sceaux "fathom inspect sceaux, binary and text" "the same poses of $(wc -l <<<"$binary") images; the same images in the third; \
other cameras, since the binary model is of the undistorted photographs"
}

other_programs() {
    local model="$out/fox/model.ply" status=0 said
    [ -f "$model" ] || { printf 'accept: run fox first, so that there is a model to open\n' >&2; return 0; }
    said=$(scripts/splat-transform.sh "$model") || status=$?
    case $status in
        0) row fox "scripts/splat-transform.sh fox/model.ply" "$said" ;;
        3) ;;
        *) miss "splat-transform does not agree about $model" ;;
    esac
}

# CPU seconds per step, bytes per Gaussian and the shares of the stages.
speed() {
    local scene result
    for scene in fox sesa-wreck; do
        have "$scene" || continue
        result="$out/speed-$scene.json"
        scripts/bench.sh "$scene" >"$result" 2>/dev/null
        row "$scene" "scripts/bench.sh $scene" "$(python3 -c 'import json, sys
r = json.load(open(sys.argv[1]))
shares = sorted(r["share_of_stage"].items(), key=lambda s: -s[1])[:8]
print("%.3f CPU s a step, %.3f s wall, %.0f bytes a Gaussian, PSNR %.2f dB at step %d; " % (r["cpu_seconds_per_step"],
    r["wall_seconds_per_step"], r["bytes_per_gaussian"], r["psnr"], r["iterations"])
    + ", ".join("%s %.0f %%" % (name, 100 * share) for name, share in shares))' "$result")" \
            "cpu_s_per_step=$(number cpu_seconds_per_step "$result")" "psnr=$(number psnr "$result")" \
            "bytes_per_gaussian=$(number bytes_per_gaussian "$result")"
    done
}

# Builds an example of core and prints its path; false if it does not build.
example() { # name, package (default fathom-core)
    cargo build --quiet --release --locked -p "${2:-fathom-core}" --example "$1" >&2 &&
        printf '%s/release/examples/%s' "$(target_folder)" "$1"
}

# One run of the trainer without a service, in a release build; its output goes to $out/NAME.json.
trainer() { # name, arguments of train_scene
    local name=$1 program
    shift
    program=$(example train_scene) || { miss "train_scene does not build"; return 1; }
    "$program" "$@" >"$out/$name.json" 2>"$out/$name.log" && return 0
    miss "train_scene $* failed: $(tail -n 1 "$out/$name.log")"
    return 1
}
quality() { # name
    printf 'PSNR %.2f dB, SSIM %.4f' "$(number psnr "$out/$1.json")" "$(number ssim "$out/$1.json")"
}
# CPU seconds of the iterations, without reading photographs and opening the device.
cpu_seconds() { # name
    awk "BEGIN { printf \"%.0f\", $(number cpu_seconds_per_step "$out/$1.json") * $(number iterations "$out/$1.json") }"
}
trainer_row() { # scene[/variant], name, command
    row "$1" "$3" "$(quality "$2") in $(cpu_seconds "$2") CPU s" "psnr=$(number psnr "$out/$2.json")" \
        "ssim=$(number ssim "$out/$2.json")" "cpu_s=$(cpu_seconds "$2")" \
        "current=$(brief "$out/$2.json") in $(cpu_seconds "$2") CPU s"
}
on_a_cpu() { # what for
    case $adapter in llvmpipe*) return 0 ;; esac
    printf 'accept: %s counts CPU seconds, which say nothing on %s\n' "$1" "$adapter" >&2
    return 1
}

# A step at the size of the Brush measurement, and the quality at its steps.
step() {
    have fox && on_a_cpu step || return 0
    local said
    said=$(scripts/bench.sh peers 2>"$out/peers.log") || { miss "scripts/bench.sh peers failed: $(tail -n 1 "$out/peers.log")"; return 0; }
    row fox "scripts/bench.sh peers" "$(paste -sd ';' <<<"$said" | tr -s ' ' | sed 's/; */; /g')" \
        "cpu_s_per_step=$(number cpu_seconds_per_step "$(target_folder)/bench/peers.json")" \
        "current=$(printf '%.3f CPU s a step' "$(number cpu_seconds_per_step "$(target_folder)/bench/peers.json")")"
    at_least 0.44 "$(number cpu_seconds_per_step "$(target_folder)/bench/peers.json")" || miss "a step of fox costs more than 0.44 CPU s"
}

# VkSplat's own program and ours on the same photographs, in turns. Both begin with 10,000 points and SH 3 and
# grow to 13,500 Gaussians by step 350. VkSplat's shaders are compiled for a CPU driver, which has no float
# atomics (scripts/peers/vksplat.sh says what is changed).
vksplat() {
    have fox && on_a_cpu vksplat || return 0
    local turn theirs=() settings=(--max-resolution 400 --max-gaussians 13500 --initial-points 10000 --iterations 600
        --evaluate-every 100 --resolution-at '[0,0]' --sh-degree-at '[0,0,0]' --background-gaussians 0)
    scripts/peers/vksplat.sh build --fallback 2>"$out/vksplat-build.log" ||
        { miss "VkSplat does not build, see $out/vksplat-build.log"; return 0; }
    for turn in ours theirs theirs ours; do
        if [ "$turn" = ours ]; then
            trainer vksplat-ours "$scenes/fox" "${settings[@]}" || return 0
            at_steps "fox/ours" "train_scene fox ${settings[*]}" "$out/vksplat-ours.json"
        else
            theirs=(--steps 600 --cap 13500 --initial-points 10000 --width-limit 400 --evaluate-at '100,300,600'
                --sh-interval 1 --refine-start 0 --refine-every 50)
            python3 scripts/peers/vksplat.py "$scenes/fox" "${theirs[@]}" >"$out/vksplat.json" 2>"$out/vksplat.log" ||
                { miss "VkSplat fails, see $out/vksplat.log"; return 0; }
            at_steps "fox/VkSplat" "scripts/peers/vksplat.py fox ${theirs[*]}" "$out/vksplat.json"
        fi
    done
    awk -v ours="$(number cpu_seconds_per_step "$out/vksplat-ours.json")" \
        -v theirs="$(number cpu_seconds_per_step "$out/vksplat.json")" 'BEGIN { exit !(ours < theirs) }' ||
        miss "a step of VkSplat is cheaper than ours"
}
at_steps() { # scene/variant, command, file with cpu_seconds_per_step and held_out
    local said cpu at_100 at_300 at_600
    said=$(python3 -c 'import json, sys
result = json.load(open(sys.argv[1]))
reached = {row.get("step", row.get("iteration")): row["psnr"] for row in result["held_out"]}
reached.setdefault(600, result.get("psnr"))
print("%.4f %.2f %.2f %.2f" % (result["cpu_seconds_per_step"], *(reached[step] for step in (100, 300, 600))))' "$3")
    read -r cpu at_100 at_300 at_600 <<<"$said"
    row "$1" "$2" "$cpu CPU s a step; $at_100, $at_300, $at_600 dB after 100, 300, 600 steps" "cpu_s_per_step=$cpu" \
        "psnr_100=$at_100" "psnr_300=$at_300" "psnr=$at_600" "current=$(printf '%.3f CPU s a step; %.1f, %.1f, %.1f dB' "$cpu" "$at_100" "$at_300" "$at_600")"
}

# Quality per CPU time, against OpenSplat's 27.88 dB in 219 CPU seconds: 28 dB in 220, with a target of 110.
quality_for_time() {
    have fox && on_a_cpu quality_for_time || return 0
    local settings=(--iterations 400 --max-gaussians 20000 --resolution-at '[0.1,0.5]')
    trainer quality "$scenes/fox" "${settings[@]}" || return 0
    trainer_row fox quality "train_scene fox ${settings[*]}"
    at_least "$(number psnr "$out/quality.json")" 28 || miss "fox has less than 28 dB"
    at_least 110 "$(cpu_seconds quality)" || miss "fox took more than 110 CPU s"
}

reef_360() {
    have reef-clip || return 0
    local settings=(--max-resolution 360 --iterations 2000 --max-gaussians 60000)
    trainer reef360 "$scenes/reef-clip" "${settings[@]}" || return 0
    trainer_row reef-clip reef360 "train_scene reef-clip ${settings[*]}"
    at_least "$(number psnr "$out/reef360.json")" 25.35 || miss "reef-clip has less than 25.35 dB"
    at_least "$(number ssim "$out/reef360.json")" 0.884 || miss "reef-clip has an SSIM of less than 0.884"
}

# Compact moments against f32: on fox at half size in minutes, on sesa-wreck at full size in more than an hour
# on two cores.
fox_moments() { moments_of fox 30 0 --iterations 2000 --max-gaussians 40000 --max-resolution 270; }
wreck_full() { moments_of sesa-wreck 35.8 0.933 --iterations 9000 --max-gaussians 150000 --resolution-at '[0.1,0.5]'; }
moments_of() { # scene, bounds of PSNR and SSIM, arguments
    local scene=$1 psnr=$2 ssim=$3 moments
    shift 3
    have "$scene" || return 0
    for moments in compact f32; do
        trainer "$scene-$moments" "$scenes/$scene" "$@" --moments "\"$moments\"" || return 0
        trainer_row "$scene/$moments" "$scene-$moments" "train_scene $scene $* --moments '\"$moments\"'"
    done
    at_least "$(number psnr "$out/$scene-compact.json")" "$psnr" || miss "$scene has less than $psnr dB"
    at_least "$(number ssim "$out/$scene-compact.json")" "$ssim" || miss "$scene has an SSIM of less than $ssim"
    at_least "$(number psnr "$out/$scene-compact.json")" "$(awk "BEGIN { print $(number psnr "$out/$scene-f32.json") - 0.1 }")" ||
        miss "compact moments cost $scene more than 0.1 dB"
}

# A result against its truth: picture and J.
against_truth() { # scene[/variant], name of the result, truth, what was trained
    local file="$out/$2.json"
    "$fathom" eval "$out/$2" --truth "$3" --allow-cpu --json >"$file" 2>/dev/null
    row "$1" "$4; fathom eval --truth" \
        "I $(round "$(number psnr "$file")") dB, SSIM $(number ssim "$file" | cut -c1-6); J \
$(round "$(number truth.psnr "$file")") dB, $(number truth.ssim "$file" | cut -c1-6), with one gain a channel \
$(round "$(number truth.psnr_with_gain "$file")") dB" \
        "psnr=$(number psnr "$file")" "ssim=$(number ssim "$file")" "j_psnr=$(number truth.psnr "$file")" \
        "j_ssim=$(number truth.ssim "$file")" "j_gain_psnr=$(number truth.psnr_with_gain "$file")" \
        "current=I $(brief "$file"); J $(round "$(number truth.psnr "$file")") dB, $(number truth.ssim "$file" | cut -c1-6)"
}
# The water parameters beside their truth: beta_d within 3 %, beta_b within 8 %, b_inf within 0.005.
water_parameters() { # scene/variant, name of the result, what was trained
    local lines
    mapfile -t lines <<<"$(python3 -c 'import json, sys
water = json.load(open(sys.argv[1]))["truth"]["water"]
found = lambda name: " ".join(f"{value:.4f}" for value in water["found"][name])
errors = lambda name: " / ".join(f"{100 * e:.1f}" for e in water[f"{name}_error"])
b_inf = " / ".join(f"{abs(e):.4f}" for e in water["b_inf_error"])
for name in ("beta_d", "beta_b"):
    print(name, found(name), "off by", errors(name), "%", end="; ")
print("b_inf", found("b_inf"), "off by", b_inf)
worst = max(abs(e) for e in water["b_inf_error"])
print(errors("beta_d"), "%;", errors("beta_b"), f"%; {worst:.4f}")
for name in ("beta_d", "beta_b", "b_inf"):
    print(f"{name}=" + json.dumps(water["found"][name]))
    print(f"{name}_error=" + json.dumps(water[f"{name}_error"]))' "$out/$2.json")"
    row "$1" "$3; fathom eval --truth, its water parameters" "${lines[0]}" "${lines[@]:2}" "current=${lines[1]}"
    python3 -c 'import json, sys
water = json.load(open(sys.argv[1]))["truth"]["water"]
missed = 0
for name, bound in (("beta_d", 0.03), ("beta_b", 0.08), ("b_inf", 0.005)):
    for c in range(3):
        off = abs(water["found"][name][c] - water["truth"][name][c])
        error = water["standard_error"][name][c]
        if abs(water[name + "_error"][c]) > bound:
            by = "unknown" if error is None else f"{off / error:.1f} standard errors"
            print(f"accept: {name} of channel {c} misses its aim by {by}", file=sys.stderr)
            missed += error is not None and off > 2 * error
sys.exit(missed)' "$out/$2.json" ||
        miss "the water of $2 is not within 3 %, 8 % and 0.005, nor within two standard errors, see $out/$2.json"
}

# Water and J of a survey with exact truth, and the picture without a medium.
water() {
    have sesa-wreck || return 0
    local settings=(--workers 1 --max-resolution 240 --iterations 3000 --max-gaussians 80000 --seed 1) preset
    for preset in fathom 3dgs; do
        train "water-$preset" "$scenes/sesa-wreck" --preset "$preset" "${settings[@]}"
        against_truth "sesa-wreck/$preset" "water-$preset" "$scenes/sesa-wreck/truth" "fathom train sesa-wreck --preset $preset ${settings[*]}"
    done
    water_parameters sesa-wreck/water water-fathom "fathom train sesa-wreck --preset fathom ${settings[*]}"
    at_least "$(number psnr "$out/water-fathom.json")" "$(number psnr "$out/water-3dgs.json")" ||
        miss "a medium costs PSNR on sesa-wreck"
}

water_long() {
    have sesa-wreck || return 0
    local settings=(--workers 1 --max-resolution 240 --iterations 7000 --max-gaussians 150000 --seed 1)
    train water-long "$scenes/sesa-wreck" "${settings[@]}"
    against_truth sesa-wreck water-long "$scenes/sesa-wreck/truth" "fathom train sesa-wreck ${settings[*]}"
    water_parameters sesa-wreck/water water-long "fathom train sesa-wreck ${settings[*]}"
    at_least "$(number truth.psnr "$out/water-long.json")" 28 ||
        miss "J of sesa-wreck has $(number truth.psnr "$out/water-long.json") dB, below 28"
}

# The wreck in waters that were not used for tuning: beta_d, beta_b, b_inf.
declare -A waters=(
    [green]=".45,.16,.20:.38,.20,.24:.05,.14,.12" [blue]=".24,.06,.04:.20,.08,.06:.015,.08,.17"
    [clear]=".20,.05,.03:.16,.07,.05:.01,.06,.16" [clearest]=".22,.06,.02:.18,.05,.03:.005,.04,.12"
    [coast]=".30,.08,.05:.25,.10,.08:.02,.10,.20" [brown]=".40,.20,.30:.30,.22,.32:.03,.10,.06"
    [turbid]=".60,.30,.35:.50,.35,.40:.06,.12,.08" [hazy]=".25,.10,.07:.35,.20,.15:.04,.12,.20" [air]="0,0,0:0,0,0:0,0,0"
)
can_make_wrecks() {
    have sesa-mesh || return 1
    python3 -c 'import numpy, scipy, PIL' 2>/dev/null && command -v g++ >/dev/null && return 0
    printf 'accept: other waters need g++ and numpy, scipy and Pillow, so their figures were not checked\n' >&2
    return 1
}
wreck_in() { # name of a water
    [ -d "$out/scene-$1" ] && return 0
    local d b inf
    IFS=: read -r d b inf <<<"${waters[$1]}"
    rm -rf "$out/scene-$1.part"
    python3 "$scenes/sesa-mesh/make_scene.py" "$out/scene-$1.part" --size 240x180 --focal 170 \
        --beta-d "$d" --beta-b "$b" --b-inf "$inf" >/dev/null
    mv "$out/scene-$1.part" "$out/scene-$1"
}
# Estimates from sparse points alone; their standard errors must hold.
sparse_waters() {
    can_make_wrecks || return 0
    local name
    for name in green blue clear clearest coast brown turbid hazy; do
        wreck_in "$name"
        cargo run --quiet --release --example water_prior -- "$out/scene-$name" --max-resolution 240 >"$out/sparse-$name.json"
        row "wreck in $name water" "water_prior, the wreck in $name water (${waters[$name]})" "$(python3 -c 'import json, sys
prior = json.load(open(sys.argv[1]))
for name in ("beta_d", "beta_b", "b_inf"):
    rows = zip(prior["water"][name], prior["truth"][name], prior["standard_error"][name])
    share = lambda value, truth: f"{1e4 * value:.1f}" if name == "b_inf" else f"{100 * value / truth:.1f}"
    errors = (share(v - t, t) + (" (unknown)" if e == "unknown" else f" ({share(e, t)})") for v, t, e in rows)
    print(name, "off by", ", ".join(errors), "e-4" if name == "b_inf" else "%", end="; ")' "$out/sparse-$name.json")" \
            beta_d="$(number water.beta_d "$out/sparse-$name.json")" beta_b="$(number water.beta_b "$out/sparse-$name.json")" \
            b_inf="$(number water.b_inf "$out/sparse-$name.json")"
        python3 -c 'import json, sys
prior = json.load(open(sys.argv[1]))
for name in ("beta_d", "beta_b", "b_inf"):
    for value, truth, error in zip(prior["water"][name], prior["truth"][name], prior["standard_error"][name]):
        if error != "unknown" and abs(value - truth) > 3 * error:
            sys.exit(1)' "$out/sparse-$name.json" ||
            miss "a number of the sparse prior in $name water is three standard errors off, see $out/sparse-$name.json"
    done
}
# Trained in three of them, and in air, which bounds J at these totals.
other_waters() {
    can_make_wrecks || return 0
    local settings=(--workers 1 --iterations 1000 --max-gaussians 40000 --seed 1) name command
    for name in green blue brown air; do
        wreck_in "$name"
        if [ "$name" = air ]; then
            train water-air "$out/scene-air" --preset 3dgs "${settings[@]}"
            row "wreck in air" "the same wreck in air: fathom train --preset 3dgs ${settings[*]}" \
                "PSNR $(round "$(number psnr "$out/water-air/metrics.json")") dB" "psnr=$(number psnr "$out/water-air/metrics.json")"
        else
            train "water-$name" "$out/scene-$name" "${settings[@]}"
            command="fathom train, the wreck in $name water (${waters[$name]}), ${settings[*]}"
            against_truth "wreck in $name water" "water-$name" "$out/scene-$name/truth" "$command"
            water_parameters "wreck in $name water/water" "water-$name" "$command"
        fi
    done
}

# A model blended in linear light: viewers' pictures against our own renders, from the held-out cameras.
viewer_colours() {
    have sesa-wreck || return 0
    if ! python3 -c 'import numpy, PIL' 2>/dev/null; then
        printf 'accept: viewer_colours needs numpy and Pillow, so its figures were not checked\n' >&2
        return 0
    fi
    local settings=(--workers 1 --max-resolution 240 --iterations 1000 --max-gaussians 40000 --seed 1 --set water.blend=linear) shown said
    local work="$out/viewer"
    train viewer "$scenes/sesa-wreck" "${settings[@]}"
    "$fathom" export "$work" --export-colour viewer -o "$work/viewer.ply" --allow-cpu >/dev/null
    "$fathom" export "$work" --export-colour viewer --iterations 1 -o "$work/as-it-is.ply" --allow-cpu >/dev/null
    python3 -c 'import json, sys
cameras = sorted(json.load(open(sys.argv[1] + "/cameras.json")), key=lambda camera: camera["img_name"])
json.dump(cameras[::8], open(sys.argv[1] + "/held-out.json", "w"))' "$work"
    for shown in model as-it-is viewer; do
        "$fathom" render "$work/$shown.ply" --cameras "$work/held-out.json" --max-resolution 240 -o "$work/$shown" --allow-cpu >/dev/null
    done
    said=$(python3 - "$work" <<'PY'
import glob, math, sys
from pathlib import Path
import numpy
from PIL import Image
read = lambda path: numpy.asarray(Image.open(path).convert("RGB")) / 255
def against_its_own(shown):
    own = sorted(glob.glob(f"{sys.argv[1]}/model/*.png"))
    errors = [((read(path) - read(Path(sys.argv[1]) / shown / Path(path).name)) ** 2).mean() for path in own]
    return numpy.mean([-10 * math.log10(error) for error in errors])
print("%.2f %.2f" % (against_its_own("as-it-is"), against_its_own("viewer")))
PY
)
    row sesa-wreck "fathom train sesa-wreck ${settings[*]}; fathom export --export-colour viewer" \
        "viewers show held-out views of J with ${said#* } dB against our own render, ${said% *} dB as it is" \
        "psnr=${said#* }" "psnr_without=${said% *}" "current=${said#* } dB; without the export's colours ${said% *} dB"
    at_least "${said#* }" 38 || miss "viewers show J with less than 38 dB"
}

reef_seeds=(1 2 3 4 5 6)
# Real water: a picture no worse than without a medium, and fewer floaters. Means over seeds, which change
# single views by 2 dB.
reef_water() {
    have reef-clip || return 0
    local settings=(--workers 1 --max-resolution 240 --iterations 2000 --max-gaussians 60000) preset seed
    for preset in fathom 3dgs; do
        for seed in "${reef_seeds[@]}"; do
            train "reef-$preset-$seed" "$scenes/reef-clip" --preset "$preset" "${settings[@]}" --seed "$seed"
            "$fathom" eval "$out/reef-$preset-$seed" --data "$scenes/reef-clip" --floaters --allow-cpu --json \
                >"$out/reef-$preset-$seed.json" 2>/dev/null
        done
        row "reef-clip/$preset" "fathom train reef-clip --preset $preset ${settings[*]}, seeds ${reef_seeds[*]}; fathom eval --floaters" \
            "PSNR $(of_seeds psnr "$preset" 2), mean $(mean_of_seeds psnr "$preset" 2) dB; SSIM $(of_seeds ssim "$preset" 4), mean \
$(mean_of_seeds ssim "$preset" 4); floaters $(of_seeds floaters.count "$preset" 2)" \
            "psnr=$(mean_of_seeds psnr "$preset" 6)" "ssim=$(mean_of_seeds ssim "$preset" 6)" \
            "floaters=$(mean_of_seeds floaters.count "$preset" 6)" "psnr_by_seed=[$(of_seeds psnr "$preset" 4)]" \
            "current=$(mean_of_seeds psnr "$preset" 2) dB, $(mean_of_seeds ssim "$preset" 4); floaters $(mean_of_seeds floaters.count "$preset" 2)"
    done
    local metric
    for metric in psnr ssim; do
        at_least "$(mean_of_seeds "$metric" fathom 6)" "$(mean_of_seeds "$metric" 3dgs 6)" ||
            miss "a medium costs $metric on reef-clip"
    done
    at_least "$(mean_of_seeds floaters.count fathom 6)" "$(mean_of_seeds floaters.count 3dgs 6)" &&
        miss "a medium has no fewer floaters on reef-clip"
    return 0
}
of_seeds() { # figure, preset, digits
    local seed
    for seed in "${reef_seeds[@]}"; do printf '%.*f\n' "$3" "$(number "$1" "$out/reef-$2-$seed.json")"; done | paste -sd, | sed 's/,/, /g'
}
mean_of_seeds() { # figure, preset, digits
    local seed
    for seed in "${reef_seeds[@]}"; do number "$1" "$out/reef-$2-$seed.json"; done | awk -v digits="$3" '{ sum += $1 } END { printf "%.*f", digits, sum / NR }'
}

# Open water in photographs, in a scene with exact truth, and in sparse surveys. Each is also a separate
# figure, of half an hour to two hours.
read -ra open_water_seeds <<<"${FATHOM_ACCEPT_SEEDS:-1 2 3}"
open_water() {
    for figure in open_water_photographs forward_look sparse_surveys; do
        "$figure"
    done
}

# Photographs of a scene from one side: J against a peer's, with black open water, and a picture no worse than
# without a medium. The rows to beat use the darkest pixels alone (as SeaThru), 26.7 and 26.4 dB.
open_water_photographs() {
    local settings=(--workers 1 --max-resolution 444 --iterations 2500 --max-gaussians 80000) scene preset seed judged
    if ! python3 -c 'import numpy, scipy, PIL' 2>/dev/null; then
        printf 'accept: open_water_photographs needs numpy, scipy and Pillow, so its figures were not checked\n' >&2
        return 0
    fi
    for scene in seathru-japan:26.7 seathru-curasao:26.4; do
        local least=${scene#*:}
        scene=${scene%:*}
        have "$scene" || continue
        for seed in "${open_water_seeds[@]}"; do
            for preset in fathom 3dgs; do
                train "$scene-$preset-$seed" "$scenes/$scene" --preset "$preset" "${settings[@]}" --seed "$seed"
            done
            judged=$(LEAST=$least python3 "$scenes/open_water.py" "$out/$scene-fathom-$seed" "$scenes/$scene") ||
                miss "$scene, seed $seed: light is left in open water, J is clipped, or has less than $least dB"
            row "$scene/seed $seed" "fathom train $scene ${settings[*]} --seed $seed; open_water.py" \
                "I $(round "$(number psnr "$out/$scene-fathom-$seed/metrics.json")") dB ($(round "$(number psnr "$out/$scene-3dgs-$seed/metrics.json")") with --preset 3dgs); $judged" \
                "psnr=$(number psnr "$out/$scene-fathom-$seed/metrics.json")" "psnr_3dgs=$(number psnr "$out/$scene-3dgs-$seed/metrics.json")"
            at_least "$(number psnr "$out/$scene-fathom-$seed/metrics.json")" \
                "$(awk "BEGIN { print $(number psnr "$out/$scene-3dgs-$seed/metrics.json") - 0.2 }")" ||
                miss "$scene, seed $seed: a medium costs more than 0.2 dB of I"
        done
    done
}

# A reef that ends, with exact truth of open water.
forward_look() {
    local seed command settings=(--workers 1 --iterations 2500 --max-gaussians 40000)
    rm -rf "$out/scene-forward"
    "$fathom" synth "$out/scene-forward" --look forward >/dev/null
    for seed in "${open_water_seeds[@]}"; do
        train "forward-$seed" "$out/scene-forward" "${settings[@]}" --seed "$seed"
        command="fathom synth --look forward; fathom train ${settings[*]} --seed $seed"
        against_truth "synth --look forward/seed $seed" "forward-$seed" "$out/scene-forward/truth" "$command"
        water_parameters "synth --look forward/water, seed $seed" "forward-$seed" "$command"
        row "synth --look forward/open water, seed $seed" "$command; fathom eval --truth, its open water" "$(python3 -c 'import json, sys
o = json.load(open(sys.argv[1]))["truth"]["open_water"]
listed = lambda values: " / ".join(f"{value:.4f}" for value in values or [])
share = lambda name: f"{100 * o[name]:.2f} %"
print("precision", share("precision") + ", recall", share("recall") + "; dark surfaces that lost alpha", share("dark_lost")
      + ", textureless", share("textureless_lost") + "; colour off by at most", listed(o["colour_error_max"]))' "$out/forward-$seed.json")" \
            "precision=$(number truth.open_water.precision "$out/forward-$seed.json")" \
            "recall=$(number truth.open_water.recall "$out/forward-$seed.json")" \
            "dark_lost=$(number truth.open_water.dark_lost "$out/forward-$seed.json")" \
            "textureless_lost=$(number truth.open_water.textureless_lost "$out/forward-$seed.json")"
        python3 -c 'import json, sys
o = json.load(open(sys.argv[1]))["truth"]["open_water"]
sound = o["precision"] >= .98 and o["recall"] >= .98 and max(o["dark_lost"], o["textureless_lost"]) <= .01
sys.exit(not (sound and max(o["colour_error_max"] or [1]) <= .005))' "$out/forward-$seed.json" ||
            miss "open water of the forward look, seed $seed, see $out/forward-$seed.json"
    done
}

# Surveys from above, so sparse that two views see each place: no holes, and J at most 1 dB below that of a
# dense survey of the same water. Lines of a name and the arguments of make_scene.py.
sparse_surveys() {
    can_make_wrecks || return 0
    local name arguments seed judged settings=(--workers 1 --max-resolution 160 --iterations 1500 --max-gaussians 40000)
    while read -r name arguments; do
        local scene="$out/scene-$name" dense="$arguments --line-spacing 4 --step 2.6 --oblique 7"
        survey "$scene" "$arguments"
        survey "$scene-dense" "$dense"
        train "$name-dense" "$scene-dense" "${settings[@]}" --seed 1
        against_truth "$name/dense" "$name-dense" "$scene-dense/truth" "make_scene.py $dense; fathom train ${settings[*]} --seed 1"
        for seed in "${open_water_seeds[@]}"; do
            train "$name-$seed" "$scene" "${settings[@]}" --seed "$seed"
            train "$name-3dgs-$seed" "$scene" --preset 3dgs --set train.background_gaussians=0 "${settings[@]}" --seed "$seed"
            against_truth "$name/seed $seed" "$name-$seed" "$scene/truth" "make_scene.py $arguments; fathom train ${settings[*]} --seed $seed"
            at_least "$(number truth.psnr "$out/$name-$seed.json")" \
                "$(awk "BEGIN { print $(number truth.psnr "$out/$name-dense.json") - 1 }")" ||
                miss "$name, seed $seed: J is more than 1 dB below that of a dense survey"
            judged=$(python3 - "$out/$name-$seed/metrics.json" "$out/$name-3dgs-$seed/metrics.json" <<'PY'
import json, sys
ours, plain = (json.load(open(path)) for path in sys.argv[1:])
by_name = {view["name"]: view["psnr"] for view in plain["views"]}
worst = min(view["psnr"] - by_name[view["name"]] for view in ours["views"])
print(f"worst view against --preset 3dgs {worst:.2f} dB, holes {100 * (ours['holes'] or 0):.2f} %")
sys.exit(worst < -2 or (ours["holes"] or 0) > 0.005)
PY
            ) || miss "a view of $name, seed $seed, is more than 2 dB below --preset 3dgs, or has holes"
            row "$name/views, seed $seed" "make_scene.py $arguments; fathom train ${settings[*]} --seed $seed, beside --preset 3dgs" "$judged"
        done
    done <<'SURVEYS'
sparse9 --line-spacing 9 --step 6 --oblique 12 --seed 77
sparse8 --line-spacing 8 --step 5 --oblique 12 --seed 78 --beta-d .24,.06,.04 --beta-b .20,.08,.06 --b-inf .015,.08,.17
sparse10 --line-spacing 10 --step 6 --oblique 12 --seed 79 --beta-d .45,.16,.20 --beta-b .38,.20,.24 --b-inf .05,.14,.12
SURVEYS
}

# A survey of the wreck, created once.
survey() { # folder, arguments of make_scene.py
    [ ! -d "$1" ] || return 0
    rm -rf "$1.part"
    # shellcheck disable=SC2086
    python3 "$scenes/sesa-mesh/make_scene.py" "$1.part" $2 >/dev/null
    mv "$1.part" "$1"
}

fox_long() {
    have fox || return 0
    local settings=(--iterations 7000 --max-gaussians 150000 --resolution-at '[0.1,0.5]')
    trainer fox-long "$scenes/fox" "${settings[@]}" || return 0
    trainer_row fox fox-long "train_scene fox ${settings[*]}"
    at_least "$(number psnr "$out/fox-long.json")" 29 || miss "fox has less than 29 dB after 7000 iterations"
}

# More Gaussians than fit one binding; a quarter of an hour on two cores.
twelve_million() {
    local program
    program=$(example train_random) || { miss "train_random does not build"; return 0; }
    if "$program" >"$out/twelve-million.log" 2>&1; then
        row synthetic train_random "$(grep -E 'step|bytes' "$out/twelve-million.log" | paste -sd ';' | sed 's/;/; /g')"
    else
        miss "twelve million Gaussians do not train: $(tail -n 1 "$out/twelve-million.log")"
    fi
}

# Wall clock of 32 cells on 1, 2 and 4 workers, as a share of the best schedule of their task times.
parallel() {
    local workers wall share
    scripts/parallel.py --json >"$out/parallel.json" || {
        case $? in
            3) printf 'accept: 1, 2 and 4 workers were not checked: no control groups\n' >&2 ;;
            *) miss "no measurement of 1, 2 and 4 workers" ;;
        esac
        return 0
    }
    python3 -c 'import json, sys
for run in json.load(open(sys.argv[1]))["runs"]:
    print(run["workers"], run["wall"], run["share"])' "$out/parallel.json" >"$out/parallel.txt"
    while read -r workers wall share; do
        row "synth/$workers workers" "scripts/parallel.py" "$(round "$wall") s, $(round "$share") of the best schedule" \
            "wall_s=$wall" "share=$share"
        at_least "$share" 0.95 || miss "$workers workers need $(round "$wall") s, $(round "$share") of the best schedule"
    done <"$out/parallel.txt"
}

# A pool seen through its surface: method wsgs against 3dgs at equal totals, three seeds, and the surface that
# is trained from a wrong start, and a long pool in partitions. Two hours on two cores;
# FATHOM_ACCEPT_ITERATIONS="3000 10000" adds long runs.
wsgs() {
    local program pool="$out/pool" iterations seed method kind least
    program=$(example train_surface) || { miss "train_surface does not build"; return 0; }
    [ -d "$pool" ] || "$fathom" synth "$pool" --kind pool --size 160x120 >"$out/pool.log"
    for iterations in ${FATHOM_ACCEPT_ITERATIONS:-3000}; do
        for method in 3dgs wsgs; do
            for seed in 1 2 3; do
                "$program" "$pool" --method "$method" --train "iterations=$iterations" --train "seed=$seed" \
                    >"$out/pool-$method-$iterations-$seed.json" 2>"$out/pool-$method.log" ||
                    { miss "the pool does not train: $(tail -n 1 "$out/pool-$method.log")"; return 0; }
            done
            for kind in entire region dry oil; do
                mean_of "${kind}_db" "$out/pool-$method-$iterations-"?.json >"$out/pool-$method-$iterations.$kind"
            done
            row "pool/$method $iterations" "train_surface POOL --method $method --train iterations=$iterations" \
                "$(paste -sd ' ' "$out/pool-$method-$iterations".{entire,region,dry,oil}) dB entire, region, dry, oil" \
                "entire_db=$(cat "$out/pool-$method-$iterations.entire")" "region_db=$(cat "$out/pool-$method-$iterations.region")" \
                "dry_db=$(cat "$out/pool-$method-$iterations.dry")" "oil_db=$(cat "$out/pool-$method-$iterations.oil")"
        done
        least=6
        [ "$iterations" -lt 10000 ] || least=8
        gains "$iterations" region "$least"
        gains "$iterations" entire 2
        gains "$iterations" dry 8
        at_least "$(cat "$out/pool-wsgs-$iterations.dry")" 26 || miss "the dry pool has less than 26 dB"
        at_least "$(cat "$out/pool-wsgs-$iterations.oil")" 25 || miss "the pool of oil has less than 25 dB"
        cost "$iterations"
    done
    "$program" "$pool" --shift 0.18 --surface refine=offset --surface refine_until=1 >"$out/pool-shifted.json" 2>"$out/pool-shifted.log" ||
        { miss "the shifted surface does not train"; return 0; }
    row "pool/shifted" "train_surface POOL --shift 0.18 --surface refine=offset --surface refine_until=1" \
        "the offset ends $(number offset_error "$out/pool-shifted.json") m off" "offset_error=$(number offset_error "$out/pool-shifted.json")"
    # 3 % of the viewing distance, 2.36.
    awk -v off="$(number offset_error "$out/pool-shifted.json")" 'BEGIN { exit !(off * off <= 0.0708 * 0.0708) }' ||
        miss "the shifted surface ends more than 3 % of the viewing distance off"
    long_pool
}
# A pool of 4 m in 2x2 partitions, without and with border training, against one.
long_pool() {
    local pool="$out/long-pool" cut name settings=(--preset wsgs --iterations 3000 --max-gaussians 16000)
    [ -d "$pool" ] || "$fathom" synth "$pool" --kind pool --length 4 --size 128x96 --views 96 >"$out/long-pool.log"
    for cut in 1x1 2x2 "2x2 --set borders.enabled=true"; do
        name=${cut%% *}
        [ "$cut" = "$name" ] || name+=-borders
        # shellcheck disable=SC2086  # several words
        train "long-pool-$name" "$pool" --partitions $cut --workers 2 "${settings[@]}" ||
            { miss "the long pool does not train in $cut"; return 0; }
        row "long-pool/$name" "fathom train POOL --partitions $cut ${settings[*]}" \
            "$(brief "$out/long-pool-$name/metrics.json")" "psnr=$(number psnr "$out/long-pool-$name/metrics.json")"
    done
    python3 - "$out" <<'PY' || miss "2x2 partitions with trained borders cost a long pool more than 0.3 dB, or a view more than 1 dB"
import json, sys
whole, cut = (json.load(open(f"{sys.argv[1]}/long-pool-{name}/metrics.json")) for name in ("1x1", "2x2-borders"))
views = {view["name"]: view["psnr"] for view in whole["views"]}
worst = min(view["psnr"] - views[view["name"]] for view in cut["views"])
print(f"long pool: {cut['psnr'] - whole['psnr']:+.2f} dB in 2x2, worst view {worst:+.2f} dB")
sys.exit(cut["psnr"] < whole["psnr"] - 0.3 or worst < -1.0)
PY
}
gains() { # iterations, kind, least gain of wsgs over 3dgs in dB
    local gain
    gain=$(awk -v a="$(cat "$out/pool-wsgs-$1.$2")" -v b="$(cat "$out/pool-3dgs-$1.$2")" 'BEGIN { print a - b }')
    at_least "$gain" "$3" || miss "wsgs gains $(round "$gain") dB ($2) over 3dgs after $1 iterations, not $3"
}
# A step of wsgs against one of 3dgs, once all Gaussians are there.
cost() { # iterations
    local method times=()
    for method in wsgs 3dgs; do
        times+=("$(mean_of ms_per_step_at_the_end "$out/pool-$method-$1-"?.json)")
    done
    row "pool/step $1" "train_surface POOL --train iterations=$1" "${times[0]} ms a step, 3dgs ${times[1]} ms" \
        "wsgs_ms=${times[0]}" "3dgs_ms=${times[1]}"
    awk -v a="${times[0]}" -v b="${times[1]}" 'BEGIN { exit !(a <= 3 * b) }' ||
        miss "a step of wsgs takes more than 3 times as long as one of 3dgs: ${times[*]} ms"
}
# Depth of disks against that of 3D Gaussians on the wreck.
disk_depth() {
    have sesa-wreck/truth/depth_m.npz || return 0
    local method seed name error errors medians=() settings=(--max-resolution 240 --iterations 3000 --max-gaussians 80000)
    for method in splats 2dgs; do
        errors=()
        for seed in ${FATHOM_ACCEPT_SEEDS:-1 2 3}; do
            name="depth-$method-$seed"
            train "$name" "$scenes/sesa-wreck" --method "$method" --seed "$seed" "${settings[@]}" &&
                error=$(scripts/depth_error.py "$fathom" "$out/$name" "$scenes/sesa-wreck") ||
                { miss "no depth of the wreck with --method $method"; return 0; }
            errors+=("$error")
        done
        medians+=("$(printf '%s\n' "${errors[@]}" | awk '{ sum += $1 } END { printf "%.4f", sum / NR }')")
        row "sesa-wreck/$method" "fathom train sesa-wreck --method $method ${settings[*]}" \
            "median depth error ${errors[*]} m by seed" "depth_error_m=${medians[-1]}"
    done
    awk -v disks="${medians[1]}" -v splats="${medians[0]}" 'BEGIN { exit !(disks <= 0.8 * splats) }' ||
        miss "disks have a median depth error of ${medians[1]} m, 3D Gaussians of ${medians[0]} m: not 20 % less"
}
mean_of() { # path of a key, JSON files
    python3 -c 'import json, sys
values = [json.load(open(path))[sys.argv[1]] for path in sys.argv[2:]]
print(round(sum(values) / len(values), 2))' "$@"
}

# Every driver that a CPU runs: a row for each driver and part.
drivers() { # parts of scripts/drivers.sh, default all but memory
    local driver part result text
    scripts/drivers.sh "$@" >"$out/drivers.txt" 2>"$out/drivers.log" || miss "a driver fails, see $out/drivers.txt"
    while read -r driver part result text; do
        [ "$driver" = driver ] || row "$driver/$part" "scripts/drivers.sh $part $driver" "$result: $text"
    done <"$out/drivers.txt"
}
# Peak memory at 1 M Gaussians, photographs of a megapixel included, beside the forecast.
memory_1m() { drivers memory; }

demo() {
    FATHOM_DEMO_STRICT=1 FATHOM_DEMO_OUT="$out/demo" scripts/demo.sh >"$out/demo.log" || miss "the demo failed, see $out/demo.log"
    row synth "make demo" "$(grep -E '^(metrics|time):' "$out/demo.log" | sed -E 's/^[a-z]+: *//' | paste -sd ';')" \
        "psnr=$(number psnr "$out/demo/result/metrics.json")" "ssim=$(number ssim "$out/demo/result/metrics.json")" \
        "current=$(brief "$out/demo/result/metrics.json"); trained in $(sed -nE 's/^time:.* training ([0-9]+) s.*/\1/p' "$out/demo.log") s"
}

all='plans plan_scale merge_scale partitions readers demo fox other_programs speed step vksplat quality_for_time reef_360 fox_moments reef wreck water water_long sparse_waters other_waters viewer_colours reef_water
open_water fox_long wreck_full
twelve_million parallel drivers memory_1m wsgs disk_depth'
for figure in ${1:-$all}; do
    "$figure"
done
if [ "$failures" -gt 0 ]; then
    printf 'accept: %d figures missed their bounds\n' "$failures" >&2
    exit 1
fi
printf 'accept: done\n'
