#!/usr/bin/env bash
# Runs the trainer on every Vulkan driver that a CPU can run, and compares them.
#
#     scripts/drivers.sh                     all of the below, as a table; about 25 minutes on 2 cores
#     scripts/drivers.sh kernels|first|train|validation|memory [DRIVER ...]
#     scripts/drivers.sh fetch               only fetches SwiftShader and the validation layer
#
# Drivers: lavapipe-128, lavapipe-256, lavapipe-512 (Mesa with vectors of so many bits, which are subgroups of
# 4, 8 and 16 lanes) and swiftshader (Google's driver: another compiler, another memory model, subgroups of
# 4).
#
#     kernels     the tests of `core/tests/kernels`: each kernel against its twin
#     first       picture and gradients of one iteration, compared with lavapipe-256
#                 (core/examples/first_iteration.rs)
#     train       a short training twice, and once stopped and resumed: the same bytes on one driver, and a
#                 PSNR within 0.5 dB of that on lavapipe-256
#     validation  a short training under the Khronos validation layer: core and synchronisation on all
#                 drivers, GPU-assisted on lavapipe-256. It fails on every message that is not in ALLOWED
#     memory      (only when named; 15 minutes) peak memory of a training of 1 M Gaussians from photographs of
#                 1 megapixel: the forecast must be within 10 % of it
#
# SwiftShader and a current validation layer come from Debian's package chromium-common, which is unpacked,
# not installed, into `drivers` below the target folder.
set -euo pipefail
cd "$(dirname "$0")/.."

target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
folder=$target/drivers
out=$folder/out
fathom=$target/debug/fathom
ALL=(lavapipe-128 lavapipe-256 lavapipe-512 swiftshader)
# Messages of the validation layer that are no fault of ours, by id, with the reason.
declare -A ALLOWED=(
    # naga 30 decorates the layout of types that variables in function and workgroup memory share with
    # buffers. No driver reads the decoration there.
    [VUID-StandaloneSpirv-None-10684]="naga's layout decorations on variables that no buffer holds"
    [CURRENT-VALIDATION-ENABLED]="the layer's list of what is on"
    [VALIDATION-SETTINGS]="the layer's remark that GPU-assisted checks are slow beside the others"
    [WARNING-Setting-Limit-Adjusted]="the layer lowers a limit to make room for its own buffer"
    [WARNING-cache-file-error]="the layer's cache of shaders, which is not there in the first run"
    # NVIDIA's driver loads a function of video encoding like this, and not we.
    [WARNING-vkGetDeviceProcAddr-device]="a driver asks the device for a function of the instance"
)

say() { printf 'drivers: %s\n' "$*" >&2; }

# SwiftShader and the layer, from the system or unpacked.
fetch() {
    local from
    for from in /usr/lib/chromium "$folder/usr/lib/chromium"; do
        if [ -e "$from/libvk_swiftshader.so" ] && [ -e "$from/libVkLayer_khronos_validation.so" ]; then
            chromium=$from
            return 0
        fi
    done
    command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || return 1
    mkdir -p "$folder/package"
    say "fetching chromium-common (31 MB) for SwiftShader and the validation layer"
    (cd "$folder/package" && apt-get download -qq chromium-common >/dev/null 2>&1) || return 1
    # Moved into place when it is whole: what is there is taken for complete.
    dpkg-deb -x "$folder"/package/chromium-common_*.deb "$folder/package/unpacked" || return 1
    rm -rf "${folder:?}/usr"
    mv "$folder/package/unpacked/usr" "$folder/usr"
    rm -rf "$folder/package"
    chromium=$folder/usr/lib/chromium
    [ -e "$chromium/libvk_swiftshader.so" ]
}

# Runs a command on a driver.
on() {
    local driver=$1 icd
    shift
    case "$driver" in
        lavapipe-*)
            icd=$(compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' | head -n 1)
            LP_NATIVE_VECTOR_WIDTH=${driver#lavapipe-} VK_DRIVER_FILES=$icd VK_ICD_FILENAMES=$icd "$@"
            ;;
        swiftshader)
            icd=$chromium/vk_swiftshader_icd.json
            VK_DRIVER_FILES=$icd VK_ICD_FILENAMES=$icd "$@"
            ;;
        *)
            say "there is no driver $driver; use ${ALL[*]}"
            exit 2
            ;;
    esac
}

failures=0
row() { printf '%-14s %-12s %-6s %s\n' "$1" "$2" "$3" "$4"; }
fail() {
    row "$1" "$2" FAILED "$3"
    failures=$((failures + 1))
}

build() {
    cargo build --workspace --bin fathom --example first_iteration --example train_scene
    kernels=$(cargo test --workspace --test kernels --no-run --message-format=json \
        | sed -nE 's/.*"name":"kernels".*"executable":"([^"]+)".*/\1/p' | tail -n 1)
    [ -x "$kernels" ] || { say "the tests of the kernels do not build"; exit 1; }
    mkdir -p "$out"
    [ -d "$out/scene" ] || "$fathom" synth "$out/scene" --views 24 --size 96x72 --seed 5 >/dev/null
}

kernels() {
    local driver=$1 log=$out/kernels-$1.log
    if (cd core && FATHOM_TEST_REQUIRE_GPU=1 on "$driver" "$kernels" >"$log" 2>&1); then
        row "$driver" kernels ok "$(grep -oE '[0-9]+ passed' "$log" | tail -n 1)"
    else
        fail "$driver" kernels "$(grep -oE '[0-9]+ passed; [0-9]+ failed' "$log" | tail -n 1); see $log"
    fi
}

first() {
    local driver=$1 file=$out/first-$1.bin base=$out/first-lavapipe-256.bin said
    [ -e "$base" ] || on lavapipe-256 "$target/debug/examples/first_iteration" write "$base" >/dev/null 2>&1
    if ! on "$driver" "$target/debug/examples/first_iteration" write "$file" >"$out/first-$driver.log" 2>&1; then
        fail "$driver" first "it does not run; see $out/first-$driver.log"
    elif said=$("$target/debug/examples/first_iteration" compare "$base" "$file" 2>&1); then
        row "$driver" first ok "apart at most $(grep -oE ': [0-9.e-]+ of' <<<"$said" | tr -d ': of' | sort -g | tail -n 1) of the size"
    else
        fail "$driver" first "$said"
    fi
}

# Trains into a folder and prints the digest of the model.
trained() {
    local driver=$1 into=$2
    shift 2
    rm -rf "$into"
    on "$driver" "$fathom" train "$out/scene" -o "$into" --allow-cpu --iterations 300 --max-gaussians 3000 --seed 3 "$@" \
        >"$into.log" 2>&1 || return 1
    digest "$into"
}
digest() { sha256sum "$1/model.ply" | cut -c 1-16; }

train() {
    local driver=$1 into=$out/train-$1 base=$out/train-lavapipe-256 one two resumed begin seconds
    [ -e "$base/metrics.json" ] || trained lavapipe-256 "$base" >/dev/null
    begin=$SECONDS
    one=$(trained "$driver" "$into") || { fail "$driver" train "it fails; see $into.log"; return; }
    seconds=$((SECONDS - begin))
    two=$(trained "$driver" "$into-again") || { fail "$driver" train "it fails; see $into-again.log"; return; }
    resumed=$(stopped_and_resumed "$driver" "$into-resumed") || { fail "$driver" train "it does not resume; see $into-resumed.log"; return; }
    local here there
    here=$("$fathom" eval "$into" --json | psnr_of) there=$("$fathom" eval "$base" --json | psnr_of)
    if [ "$one" != "$two" ] || [ "$one" != "$resumed" ]; then
        fail "$driver" train "models differ: $one, again $two, resumed $resumed"
    elif ! awk -v a="$here" -v b="$there" 'BEGIN { d = a - b; exit !(d < 0.5 && d > -0.5) }'; then
        fail "$driver" train "$here dB, $there dB on lavapipe-256"
    else
        row "$driver" train ok "$(printf '%.2f' "$here") dB, model $one three times, $seconds s"
    fi
}
psnr_of() { grep -oE '"psnr": ?[0-9.]+' | head -n 1 | grep -oE '[0-9.]+'; }

# Stops a run in its middle and resumes it. A run that ended before it was stopped is tried again, stopped
# sooner.
stopped_and_resumed() {
    local driver=$1 into=$2 after child
    local command=("$fathom" train "$out/scene" -o "$into" --allow-cpu --iterations 300 --max-gaussians 3000 --seed 3)
    for after in 3 2 1; do
        rm -rf "$into"
        on "$driver" exec_in_background "$into.log" "${command[@]}"
        child=$background
        sleep "$after"
        if kill -INT "$child" 2>/dev/null; then
            wait "$child" || true
            [ -e "$into/model.ply" ] && continue
            on "$driver" "${command[@]}" --resume >>"$into.log" 2>&1 || return 1
            digest "$into"
            return 0
        fi
        wait "$child" || true
    done
    return 1
}
exec_in_background() {
    local log=$1
    shift
    "$@" >"$log" 2>&1 &
    background=$!
}

# A short training under the layer, with these settings.
under_layer() {
    local driver=$1 name=$2 iterations=$3 log=$out/validation-$1-$2.txt layer=$folder/layer
    shift 3
    mkdir -p "$layer"
    cat >"$layer/VkLayer_khronos_validation.json" <<JSON
{ "file_format_version": "1.1.2", "layer": { "name": "VK_LAYER_KHRONOS_validation", "type": "GLOBAL",
  "library_path": "$chromium/libVkLayer_khronos_validation.so", "api_version": "1.4.0", "implementation_version": "1",
  "description": "Khronos validation", "instance_extensions": [
    { "name": "VK_EXT_debug_utils", "spec_version": "1" }, { "name": "VK_EXT_layer_settings", "spec_version": "2" } ] } }
JSON
    {
        printf 'khronos_validation.%s\n' 'debug_action = VK_DBG_LAYER_ACTION_LOG_MSG' "log_filename = $log" \
            'report_flags = error,warn,info' 'validate_core = true' 'enable_message_limit = false' "$@"
    } >"$layer/settings.txt"
    rm -rf "$log" "$out/validation"
    if ! VK_INSTANCE_LAYERS=VK_LAYER_KHRONOS_validation VK_LAYER_PATH=$layer VK_LAYER_SETTINGS_PATH=$layer/settings.txt \
        on "$driver" "$fathom" train "$out/scene" -o "$out/validation" --allow-cpu --iterations "$iterations" \
        --max-gaussians 2000 --seed 1 >"$out/validation.log" 2>&1; then
        fail "$driver" "$name" "the training fails; see $out/validation.log"
        return
    fi
    # Silence of a layer that was not loaded would prove nothing: it lists itself what it checks.
    if ! grep -q 'CURRENT-VALIDATION-ENABLED' "$log" 2>/dev/null; then
        fail "$driver" "$name" "the validation layer was not loaded"
        return
    fi
    local id known=0 unknown=()
    while read -r id; do
        if [ -n "${ALLOWED[$id]:-}" ]; then known=$((known + 1)); else unknown+=("$id"); fi
    done < <(sed -nE 's/^Validation [A-Z][a-z ]+: \[ ([^] ]+) \].*/\1/p' "$log")
    if [ "${#unknown[@]}" -gt 0 ]; then
        fail "$driver" "$name" "${#unknown[@]} messages: $(printf '%s\n' "${unknown[@]}" | sort | uniq -c | tr -s '\n ' ' '); see $log"
    else
        row "$driver" "$name" ok "$iterations iterations; $known messages, all in the list of known ones"
    fi
}
validation() {
    under_layer "$1" validation 100 'validate_sync = true'
    if [ "$1" = lavapipe-256 ]; then
        under_layer "$1" gpu-assisted 20 'validate_sync = false' 'gpuav_enable = true'
    fi
}

# 24 photographs of 1184x888 and 1.3 million points, of which a run takes 1 million.
memory() {
    local driver=$1 scene=$folder/out/large result=$out/memory-$1.json peak forecast
    if [ ! -e "$scene/truth/water.json" ]; then
        rm -rf "$scene"
        "$fathom" synth "$scene" --water off --views 24 --size 1184x888 --points-per-view 60000 >/dev/null 2>&1
    fi
    if ! on "$driver" "$target/debug/examples/train_scene" "$scene" --iterations 24 --max-gaussians 1000000 \
        --resolution-at '[0,0]' --sh-degree-at '[0,0,0]' >"$result" 2>"$result.log"; then
        fail "$driver" memory "it fails; see $result.log"
        return
    fi
    peak=$(sed -nE 's/^  "device_peak_bytes": ([0-9]+),$/\1/p' "$result")
    forecast=$(sed -nE 's/^  "forecast_bytes": ([0-9]+),$/\1/p' "$result")
    if awk -v f="$forecast" -v p="$peak" 'BEGIN { exit !(f < 1.1 * p && f > 0.9 * p) }'; then
        row "$driver" memory ok "$((peak / 1000000)) bytes a Gaussian, forecast $((forecast / 1000000))"
    else
        fail "$driver" memory "peak $peak bytes, forecast $forecast"
    fi
}

parts=(kernels first train validation)
case "${1:-all}" in
    all) shift "$#" ;;
    fetch) fetch || { say "SwiftShader is not at hand: chromium-common is neither installed nor can be fetched"; exit 1; }; exit 0 ;;
    kernels | first | train | validation | memory) parts=("$1"); shift ;;
    *) sed -n '2,23p' "$0"; exit 2 ;;
esac
drivers=("${@:-${ALL[@]}}")
[ "$#" -gt 0 ] || drivers=("${ALL[@]}")
if ! fetch; then
    say "SwiftShader and the validation layer are not at hand (Debian's chromium-common); only lavapipe is tested"
    mapfile -t drivers < <(printf '%s\n' "${drivers[@]}" | grep -v swiftshader)
    mapfile -t parts < <(printf '%s\n' "${parts[@]}" | grep -v validation)
fi
build
row driver part result figure
for driver in "${drivers[@]}"; do
    for part in "${parts[@]}"; do
        "$part" "$driver"
    done
done
if [ "$failures" -gt 0 ]; then
    say "$failures parts failed"
    exit 1
fi
