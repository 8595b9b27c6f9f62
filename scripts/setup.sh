#!/usr/bin/env bash
# Prepares a machine to build and run Fathom: Rust is required, everything else is installed here.
#
# Installs only a Vulkan loader and Mesa's drivers (which include lavapipe, the CPU driver), and only if no
# Vulkan driver is found. With --for-tests, also PostgreSQL, whose server the tests start and stop themselves,
# and Chromium and npm for the pages. Otherwise does nothing.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*"; }
fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}

if ! command -v cargo >/dev/null; then
    if [ -x "$HOME/.cargo/bin/cargo" ]; then
        fail "cargo is installed but not on the PATH; run: . \"\$HOME/.cargo/env\""
    fi
    fail "Rust is missing; install it with rustup (1.95 or newer) and run this again"
fi
if ! command -v cc >/dev/null && ! command -v gcc >/dev/null && ! command -v clang >/dev/null; then
    needs_linker=yes
fi

have_loader() {
    compgen -G '/usr/lib/*/libvulkan.so.1' >/dev/null || compgen -G '/usr/lib*/libvulkan.so.1' >/dev/null \
        || compgen -G '/usr/local/lib*/libvulkan.so.1' >/dev/null
}
have_driver() {
    [ -n "${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-}" ] && return 0
    # Without a GPU only the CPU driver helps, whatever others are installed.
    local drivers='*.json'
    [ -e /dev/nvidia0 ] || compgen -G '/dev/dri/renderD*' >/dev/null || drivers='lvp_icd*.json'
    compgen -G "/usr/share/vulkan/icd.d/$drivers" >/dev/null || compgen -G "/etc/vulkan/icd.d/$drivers" >/dev/null \
        || compgen -G "/usr/local/share/vulkan/icd.d/$drivers" >/dev/null
}

have_postgres() {
    command -v initdb >/dev/null || compgen -G '/usr/lib/postgresql/*/bin/initdb' >/dev/null
}

packages=()
[ "${needs_linker:-no}" = yes ] && packages+=(gcc libc6-dev)
if [ "$(uname -s)" = Linux ]; then
    have_loader || packages+=(libvulkan1)
    have_driver || packages+=(mesa-vulkan-drivers)
fi
# Without apt-get, tests of a database are skipped.
if [ "${1:-}" = --for-tests ] && ! have_postgres && command -v apt-get >/dev/null; then
    packages+=(postgresql)
fi

install() {
    command -v apt-get >/dev/null \
        || fail "please install $* (Debian's names) with this system's package manager"
    local as_root=()
    if [ "$(id -u)" -ne 0 ]; then
        command -v sudo >/dev/null || fail "please install as root: apt-get install $*"
        as_root=(sudo)
    fi
    say "installing $* with apt-get (about 1 minute)"
    "${as_root[@]}" apt-get update -qq
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
    say "installed $*"
}

[ "${#packages[@]}" -eq 0 ] || install "${packages[@]}"

# Each system has another browser, and none is needed but by the tests of pages, which say what they lack.
if [ "${1:-}" = --for-tests ]; then
    pages=()
    [ -n "${CHROMIUM:-}" ] || command -v chromium-headless-shell chromium google-chrome >/dev/null \
        || pages+=(chromium-headless-shell)
    command -v npm >/dev/null || pages+=(npm)
    if [ "${#pages[@]}" -gt 0 ]; then
        (install "${pages[@]}") || say "without ${pages[*]} the pages are not tested"
    fi
fi

if [ ! -e "${CARGO_TARGET_DIR:-target}/debug" ]; then
    say "the first build compiles all dependencies: about 7 minutes on 2 cores"
fi
