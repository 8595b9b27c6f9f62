#!/usr/bin/env bash
# Times a clean build of `fathom`, and its rebuild after a change of one line in the plan and in the trainer.
#
#     scripts/build_times.sh [COMMIT ...]     default: HEAD
#
# Commits are built in turns, each in a worktree and a target folder of its own below the target folder, with
# the developer's defaults. The one-line changes take three rounds. FATHOM_BUILD_ROUNDS sets another number.
set -euo pipefail
cd "$(dirname "$0")/.."

commits=("${@:-HEAD}")
rounds=${FATHOM_BUILD_ROUNDS:-3}
folder=$(realpath -m "${CARGO_TARGET_DIR:-target}")/build-times
unset CARGO_TARGET_DIR CARGO_INCREMENTAL CARGO_PROFILE_DEV_DEBUG CARGO_PROFILE_DEV_STRIP
export CARGO_TERM_COLOR=never

clean() {
    for commit in "${commits[@]}"; do
        git worktree remove --force "$folder/$commit/tree" 2>/dev/null || true
    done
    git worktree prune
    rm -rf "$folder"
}
trap clean EXIT
clean

# Builds the commit and prints what was timed.
build() {
    local commit=$1 what=$2 begin end
    begin=$(date +%s.%N)
    (cd "$folder/$commit/tree" && CARGO_TARGET_DIR="$folder/$commit/target" cargo build --workspace --bin fathom) \
        >"$folder/$commit/log" 2>&1 || { tail -n 20 "$folder/$commit/log"; exit 1; }
    end=$(date +%s.%N)
    awk -v commit="$commit" -v what="$what" -v from="$begin" -v to="$end" \
        'BEGIN { printf "%-10s %-22s %6.1f s\n", commit, what, to - from }'
}

# Adds a line to a function: the file, a pattern of the line before which it goes, and a number that differs.
change() {
    sed -i "/let _changed = /d" "$1"
    sed -i "0,/^    $2/s//    let _changed = $3;\n    $2/" "$1"
    grep -q "_changed = $3;" "$1" || { echo "$1 has no line that begins with $2"; exit 1; }
}

for commit in "${commits[@]}"; do
    mkdir -p "$folder/$commit"
    git worktree add -q --detach "$folder/$commit/tree" "$commit"
    build "$commit" "clean build"
done
for file in weights.rs init.rs; do
    for round in $(seq "$rounds"); do
        for commit in "${commits[@]}"; do
            tree=$folder/$commit/tree
            if [[ $file == weights.rs ]]; then
                # Up to 0ca6e4b the plan was a module of the coordinator.
                path=$tree/coordinator/plan/src/weights.rs
                [ -e "$path" ] || path=$tree/coordinator/src/partition/weights.rs
                change "$path" "let deepest =" "$round"
                build "$commit" "a line of the plan"
            else
                change "$tree/core/src/train/init.rs" "let far =" "$round"
                build "$commit" "a line of the trainer"
            fi
        done
    done
done
