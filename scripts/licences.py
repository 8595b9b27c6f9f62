#!/usr/bin/env python3
"""Prints the licences of every package in the binary `fathom`, from cargo's metadata and the packages' licence files.

Fails if a package has no licence, or one that is not compatible with `MIT OR Apache-2.0`.
"""
import json
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Licences allowed in a binary under MIT or Apache-2.0. One of several alternatives is enough.
COMPATIBLE = {
    "0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD-2-Clause", "BSD-3-Clause", "BSL-1.0", "CC0-1.0",
    "CDLA-Permissive-2.0", "ISC", "MIT", "MIT-0", "MPL-2.0", "Unicode-3.0", "Unlicense", "Zlib",
}


def is_compatible(expression):
    """Whether an SPDX expression of `OR`, `AND` and parentheses can be met. `/` is an old way to write `OR`."""
    words = expression.replace("/", " OR ").replace("(", " ( ").replace(")", " ) ").split()

    def one(at):
        if words[at] == "(":
            met, at = alternatives(at + 1)
            return met, at + 1
        name, at = words[at], at + 1
        if at < len(words) and words[at] == "WITH":
            name, at = f"{name} WITH {words[at + 1]}", at + 2
        return name in COMPATIBLE, at

    def all_of(at):
        met, at = one(at)
        while at < len(words) and words[at] == "AND":
            also, at = one(at + 1)
            met = met and also
        return met, at

    def alternatives(at):
        met, at = all_of(at)
        while at < len(words) and words[at] == "OR":
            other, at = all_of(at + 1)
            met = met or other
        return met, at

    return alternatives(0)[0]


def main():
    host = next(line[6:] for line in subprocess.check_output(["rustc", "-vV"], text=True).splitlines() if line.startswith("host: "))
    command = ["cargo", "metadata", "--locked", "--format-version", "1", "--filter-platform", host]
    metadata = json.loads(subprocess.check_output(command, cwd=ROOT, text=True))
    packages = {package["id"]: package for package in metadata["packages"]}
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    start = next(package["id"] for package in packages.values() if package["name"] == "fathom-cli")
    found, waiting = set(), [start]
    while waiting:
        package = waiting.pop()
        if package in found:
            continue
        found.add(package)
        for dependency in nodes[package]["deps"]:
            # Build and test dependencies are not in the binary.
            if any(kind["kind"] is None for kind in dependency["dep_kinds"]):
                waiting.append(dependency["pkg"])
    others = [packages[package] for package in found if packages[package]["source"] is not None]
    others.sort(key=lambda package: (package["name"], package["version"]))
    faults = [p for p in others if not p["license"] or not is_compatible(p["license"])]
    if faults:
        named = ", ".join(f"{p['name']} {p['version']} ({p['license']})" for p in faults)
        sys.exit(f"licences: not known to be compatible with MIT OR Apache-2.0: {named}")
    print("Fathom is licensed as MIT OR Apache-2.0. Its binary also contains these packages:\n")
    for package in others:
        print(f"{package['name']} {package['version']}: {package['license']}, {package['repository'] or 'no repository named'}")
    texts = {}
    for package in others:
        folder = pathlib.Path(package["manifest_path"]).parent
        for file in sorted(folder.iterdir()):
            if file.is_file() and file.name.upper().startswith(("LICENSE", "LICENCE", "COPYING", "NOTICE", "UNLICENSE")):
                text = file.read_text(errors="replace").strip()
                texts.setdefault(text, []).append(f"{package['name']} {package['version']}")
    for text, names in sorted(texts.items(), key=lambda item: item[1]):
        print("\n" + "=" * 80 + f"\nOf {', '.join(names)}:\n\n{text}")


if __name__ == "__main__":
    main()
