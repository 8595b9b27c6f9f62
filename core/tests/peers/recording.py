"""Writes the results of the peers as JSON with one row of an array per line, so that diffs are readable."""

import importlib.metadata
import json
import pathlib

FOLDER = pathlib.Path(__file__).parent / "expectations"
# Significant recorded digits. The tests compare at 1e-10; the f64 sums themselves agree far better.
DIGITS = 11


def versions(*packages):
    """Versions of the packages that computed the numbers, by package name."""
    return {package: importlib.metadata.version(package) for package in packages}


def write(name, content):
    """Writes `content` (dictionaries, lists, numbers, texts) to `expectations/<name>.json`."""
    FOLDER.mkdir(exist_ok=True)
    path = FOLDER / f"{name}.json"
    path.write_text(_text(content) + "\n", encoding="utf-8")
    print(f"{path.name}: {path.stat().st_size} bytes")


def _text(value):
    if isinstance(value, dict):
        return "{\n" + ",\n".join(f'"{key}": {_text(part)}' for key, part in value.items()) + "\n}"
    if isinstance(value, list) and value and isinstance(value[0], (list, dict, str)):
        return "[\n" + ",\n".join(_text(part) for part in value) + "\n]"
    if isinstance(value, list):
        return "[" + ",".join(_text(part) for part in value) + "]"
    if isinstance(value, float):
        # Whole numbers have no ".0": JSON does not distinguish 1 from 1.0, and the tests read f64.
        return f"{value:.{DIGITS}g}"
    return json.dumps(value)
