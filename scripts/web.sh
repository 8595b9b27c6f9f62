#!/usr/bin/env bash
# The pages for browsers (web/): builds them, checks them, and runs them in a browser.
#
#     scripts/web.sh build      web/dist from web/src
#     scripts/web.sh check      types, lints, unit tests; that the protos give the committed web/src/rpc, and
#                               the sources the committed web/dist
#     scripts/web.sh headless   the built pages in Chromium beside `fathom render`, before a coordinator and a
#                               worker, and for an hour of news (quick: two small models, without the hour)
#     scripts/web.sh pictures   docs/using/*.jpg of the pages, from a service with a small job; look at them
#     scripts/web.sh cost [N]   CPU time of a job with previews and an open page against one without, N pairs
#
# Needs npm and its registry. The packages, with Node as the package `node`, are those of
# web/package-lock.json; Chromium is that of the system. Exits with 3 where npm or Chromium is missing, so
# that callers can tell "not checked" from "wrong". With FATHOM_TEST_REQUIRE_BROWSER=1 that is a failure.
#
# FATHOM     the program (default: that of the development build)
# CHROMIUM   the browser (default: the first of chromium-headless-shell, chromium and google-chrome)
set -euo pipefail
self=$(realpath "$0")
cd "$(dirname "$self")/../web"

target=$(cd .. && realpath -m "${CARGO_TARGET_DIR:-target}")
fathom=${FATHOM:-$target/debug/fathom}

say() { printf 'web: %s\n' "$*" >&2; }
not_checked() {
    say "$*"
    [ "${FATHOM_TEST_REQUIRE_BROWSER:-}" = 1 ] && exit 1
    exit 3
}

# The packages of the lock file, unless they are there already.
packages() {
    command -v npm >/dev/null || not_checked "npm is missing, so the pages were not checked"
    if ! cmp -s package-lock.json node_modules/.of-lock; then
        npm ci --no-audit --no-fund --loglevel=error || not_checked "npm cannot fetch the packages, so the pages were not checked"
        cp package-lock.json node_modules/.of-lock
    fi
    # Node of the lock file before that of the system.
    PATH=$PWD/node_modules/.bin:$PATH
}

# The first that there is; the tests take the same.
find_browser() {
    [ -n "${CHROMIUM:-}" ] || CHROMIUM=$(command -v chromium-headless-shell chromium google-chrome | head -n 1) ||
        true
    export CHROMIUM
    [ -n "$CHROMIUM" ] ||
        not_checked "there is no Chromium, so the pages were not opened; run scripts/setup.sh --for-tests"
}

# Builds into a folder of its own. web/dist stays as it is: with another time of its files, cargo would build
# all that contains it again.
build_into() {
    vite build --logLevel warn --emptyOutDir --outDir "$1"
    vite build --logLevel warn --config vite.handover.config.ts --outDir "$1" --emptyOutDir false
    node scripts/compress.mjs "$1"
}

# Every file of one folder, decompressed, is that of another: compressors may differ in their versions.
same() {
    local committed=$1 built=$2 name
    diff <(cd "$committed" && find . -type f | sort) <(cd "$built" && find . -type f | sort) >&2 || return 1
    while read -r name; do
        cmp <(gzip -dc "$committed/$name") <(gzip -dc "$built/$name") >&2 || return 1
    done < <(cd "$committed" && find . -type f | sort)
}

case "${1:-}" in
    build)
        packages
        built=$(mktemp -d)
        trap 'rm -rf "$built"' EXIT
        build_into "$built"
        if same dist "$built" 2>/dev/null; then
            say "web/dist is current"
        else
            rm -rf dist
            cp -r "$built" dist
            chmod -R a+rX dist
            say "web/dist is written"
        fi
        ;;
    check)
        packages
        npm run --silent check
        npm run --silent test
        built=$(mktemp -d)
        trap 'rm -rf "$built"' EXIT
        build_into "$built" >/dev/null
        if ! same dist "$built"; then
            say "web/dist is not what web/src gives; run make web and commit web/dist"
            exit 1
        fi
        ;;
    headless)
        packages
        find_browser
        data=$(mktemp -d)
        trap 'rm -rf "$data"' EXIT
        scripts/make-test-data.sh "$fathom" "$data" ${2:+"$2"} >"$data/log" 2>&1 || {
            tail -n 20 "$data/log" >&2
            exit 1
        }
        [ "${2:-}" != quick ] || export HEADLESS_QUICK=1
        FATHOM=$fathom VIEWER_DATA=$data npm run --silent headless
        ;;
    pictures)
        packages
        find_browser
        FATHOM=$fathom node test/headless/take-pictures.ts ../docs/using
        ;;
    cost)
        packages
        find_browser
        FATHOM=$fathom node test/headless/cost.ts ${2:+"$2"}
        ;;
    *)
        sed -n '2,17p' "$self" | sed 's/^# \{0,1\}//'
        exit 2
        ;;
esac
