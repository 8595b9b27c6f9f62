#!/usr/bin/env bash
# Measures the cost of training on this machine, in release builds.
#
#     scripts/bench.sh                                    random, then the scenes
#     scripts/bench.sh random [ARGUMENTS]                 the kernels, against a baseline; arguments are
#                                                         bench_random's
#     scripts/bench.sh synth|fox|sesa-wreck               one scene: one JSON object
#     scripts/bench.sh peers                              the run that Brush was measured with, beside its
#                                                         figures
#
# Kernels: the programs of this tree and of the commit BASELINE run alternately, A B B A, FATHOM_BENCH_ROUNDS
# times each (default 4). The table has their medians and the spread of the ratios by round. The default
# BASELINE is the last release tag (v*) before HEAD; without one, HEAD for a tree with changes and HEAD~1 for
# one without. BASELINE=none measures this tree alone. The baseline is built in a worktree under the target
# folder, which is kept with its build: only the first build takes minutes.
#
# Scenes: CPU and wall seconds per step, evaluations, the share of each stage, bytes per Gaussian, held-out
# quality. Always runs the synthetic scene; fox and sesa-wreck if FATHOM_SCENES (default ../shared/scenes) has
# them. Compare CPU seconds: they do not depend on other load.
set -euo pipefail
cd "$(dirname "$0")/.."

scenes="${FATHOM_SCENES:-../shared/scenes}"
rounds="${FATHOM_BENCH_ROUNDS:-4}"
target=$(cargo metadata --no-deps --format-version 1 | sed -E 's/.*"target_directory":"([^"]*)".*/\1/')
bench="$target/bench"
mkdir -p "$bench"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

say() { printf 'bench: %s\n' "$*" >&2; }
have() { # scene
    [ -e "$scenes/$1" ] && return 0
    say "$scenes/$1 does not exist; set FATHOM_SCENES to the folder of the scenes"
    return 1
}
need_python() {
    command -v python3 >/dev/null || { say 'python3 is needed to read JSON; apt-get install python3'; exit 1; }
}

build() { # folder of a tree, its target folder, example, where the program goes
    (cd "$1" && CARGO_TARGET_DIR="$2" cargo build --quiet --release --locked -p fathom-core --example "$3") &&
        cp "$2/release/examples/$3" "$4"
}

# Output format of a tree's benchmark, from its source on stdin.
format_of() { sed -nE 's/^const FORMAT: u32 = ([0-9]+);$/\1/p'; }

# Checks out a commit in the worktree.
check_out() { # commit
    git worktree prune
    if [ -e "$bench/baseline/.git" ]; then
        git -C "$bench/baseline" checkout --quiet --force --detach "$1"
    else
        rm -rf "$bench/baseline" && git worktree add --quiet --force --detach "$bench/baseline" "$1"
    fi
}

# Builds the baseline; without one, prints the reason and returns false. `set -e` has no effect here, because
# this is called as a condition.
build_baseline() {
    local wanted=${BASELINE:-} commit ours theirs
    [ "$wanted" != none ] || return 1
    if [ -z "$wanted" ]; then
        wanted=$(git describe --tags --abbrev=0 --match 'v[0-9]*' HEAD~1 2>/dev/null) || wanted=
    fi
    if [ -z "$wanted" ]; then
        wanted=HEAD~1
        [ -z "$(git status --porcelain 2>/dev/null)" ] || wanted=HEAD
    fi
    if ! commit=$(git rev-parse --verify --quiet "$wanted^{commit}"); then
        say "there is no commit $wanted, so only this tree is measured; name another with BASELINE=<commit>"
        return 1
    fi
    ours=$(format_of <core/examples/bench_random.rs)
    theirs=$(git show "$commit:core/examples/bench_random.rs" 2>/dev/null | format_of) || theirs=
    if [ "$ours" != "$theirs" ]; then
        say "$wanted ($(git rev-parse --short "$commit")) lacks this benchmark (format ${theirs:-none}, here $ours)," \
            "so only this tree is measured; name a later commit with BASELINE=<commit>"
        return 1
    fi
    say "baseline: $(git log -1 --format='%h %s' "$commit")"
    # A separate target folder: cargo uses the same file names in every tree and would confuse them.
    if ! check_out "$commit" || ! build "$bench/baseline" "$bench/baseline-target" bench_random "$work/baseline"; then
        say "the baseline cannot be built; name another with BASELINE=<commit>, or none with BASELINE=none"
        exit 1
    fi
}

random() { # arguments of bench_random
    need_python
    local sides=(now) round order side
    if build_baseline; then
        sides=(now baseline)
    fi
    build . "$target" bench_random "$work/now"
    rm -f "$bench"/random-*.json
    for ((round = 1; round <= rounds; round++)); do
        order=("${sides[@]}")
        if [ $((round % 2)) = 0 ] && [ "${#sides[@]}" = 2 ]; then
            order=(baseline now)
        fi
        for side in "${order[@]}"; do
            say "round $round of $rounds: $side"
            "$work/$side" "$@" >"$bench/random-$side-$round.json"
        done
    done
    python3 scripts/bench_report.py random "$bench"/random-*.json
    say "as JSON: $bench/random-*.json"
}

train() { # name, folder, arguments
    build . "$target" train_scene "$work/train_scene"
    say "$1 ${*:3}"
    "$work/train_scene" "$2" "${@:3}"
}

# Reasons for the sizes: fox is the field's standard small scene, at its own size. sesa-wreck has the size of
# all our CPU comparisons. The synthetic scene is available to everyone. All schedules are shares of the run,
# so a short run covers all their parts.
scene() { # name
    case $1 in
        synth)
            cargo build --quiet --workspace --bin fathom
            "$target/debug/fathom" synth "$work/scene" >/dev/null 2>&1
            train synth "$work/scene" --iterations 400 --max-gaussians 20000 --max-resolution 240
            ;;
        fox) have fox && train fox "$scenes/fox" --iterations 1000 --max-gaussians 60000 ;;
        sesa-wreck)
            have sesa-wreck && train sesa-wreck "$scenes/sesa-wreck" \
                --iterations 1000 --max-gaussians 120000 --max-resolution 240
            ;;
    esac
}

# Size, points, cap and steps of the Brush measurement (it trains at full size and SH 3 from the first step).
peers() {
    need_python
    have fox || exit 2
    train fox "$scenes/fox" --max-resolution 400 --max-gaussians 13500 --initial-points 10000 --iterations 600 \
        --evaluate-every 100 --resolution-at '[0,0]' --sh-degree-at '[0,0,0]' --background-gaussians 0 >"$bench/peers.json"
    python3 scripts/bench_report.py peers "$bench/peers.json"
    say "as JSON: $bench/peers.json"
}

case ${1:-all} in
    all)
        random
        for name in synth fox sesa-wreck; do
            scene "$name" || say "$name was not measured"
        done
        ;;
    random) random "${@:2}" ;;
    synth | fox | sesa-wreck) scene "$1" || exit 2 ;;
    peers) peers ;;
    *)
        say "there is no benchmark $1; use random, synth, fox, sesa-wreck or peers"
        exit 2
        ;;
esac
