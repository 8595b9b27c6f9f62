#!/usr/bin/env bash
# Upgrades coordinators and workers one after another while a job runs, from another version to this one.
#
#     scripts/rolling_upgrade.sh [COMMIT]     default: HEAD~1
#
# The other version is built in a worktree and a target folder of its own, below the target folder. Both
# orders are tested, coordinators first and workers first, on PostgreSQL and an S3 server; 15 minutes on 2
# cores.
set -euo pipefail
cd "$(dirname "$0")/.."

commit=$(git rev-parse --verify "${1:-HEAD~1}^{commit}")
folder=$(realpath -m "${CARGO_TARGET_DIR:-target}")/rolling-upgrade
program=$folder/fathom-$commit

if [ ! -x "$program" ]; then
    clean() {
        git worktree remove --force "$folder/tree" 2>/dev/null || true
        git worktree prune
    }
    trap clean EXIT
    clean
    git worktree add --quiet --detach "$folder/tree" "$commit"
    (cd "$folder/tree" && CARGO_TARGET_DIR="$folder/target" cargo build --workspace --bin fathom)
    cp "$folder/target/debug/fathom" "$program"
fi
FATHOM_TEST_OLD_PROGRAM="$program" cargo test --workspace --test kills upgrade:: -- --ignored --nocapture
