#!/usr/bin/env bash
# Makes a release for this machine's Linux: a tar archive of the stripped binary `fathom` and all its
# licences, and its checksum. FATHOM_DIST_OUT is the output folder (default: out/dist).
set -euo pipefail
cd "$(dirname "$0")/.."

out="${FATHOM_DIST_OUT:-out/dist}"
version=$(sed -nE 's/^version = "(.*)"/\1/p' Cargo.toml | head -n 1)
host=$(rustc -vV | sed -n 's/^host: //p')
name="fathom-$version-$host"
target=$(cargo metadata --no-deps --format-version 1 | sed -E 's/.*"target_directory":"([^"]*)".*/\1/')

cargo build --release --locked --package fathom-cli --bin fathom
rm -rf "${out:?}/$name"
mkdir -p "$out/$name"
cp "$target/release/fathom" README.md CHANGELOG.md LICENSE-APACHE LICENSE-MIT "$out/$name/"
scripts/licences.py >"$out/$name/THIRD-PARTY-LICENCES.txt"
# The archive is reproducible: sorted names, no owner, the time of the commit.
time=$(git log -1 --format=%ct 2>/dev/null || echo 0)
tar --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$time" -C "$out" -czf "$out/$name.tar.gz" "$name"
(cd "$out" && sha256sum "$name.tar.gz" >"$name.tar.gz.sha256")
"$out/$name/fathom" --version
ls -l "$out/$name.tar.gz" "$out/$name.tar.gz.sha256"
