#!/usr/bin/env python3
"""Wraps comments and Markdown prose at 110 columns.

    scripts/rewrap.py [FILE ...]        wraps these files in place; default: all tracked ones
    scripts/rewrap.py --check [...]     prints the changes; exits with 1 if there are any
    scripts/rewrap.py --self-check      tests itself on sample comments

It only changes a paragraph with a line that is too long, and only its line breaks. It compares words and code of
every file before and after, and writes nothing if they differ. Unchanged: code, strings, heredocs, tables, code
blocks, headings, diagrams, formulas, and comments behind code. List items are wrapped with their indentation, and
lines in columns below their last column.
"""

import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

WIDTH = 110
ROOT = Path(__file__).resolve().parent.parent
# Words that Markdown would read as markup at the start of a line.
MARK = re.compile(r"[-+*>=]+$|#+$|\d+[.)]$|\||```|~~~|:{1,2}$")
ITEM = re.compile(r"(\s*)([-*+]|\d+[.)])(\s+)(?=\S)")
DRAWN = re.compile("[\u2500-\u257f\u25ba]")
# Lines that are never joined: tables, headings, HTML, link definitions, items that are one link, directives,
# and settings in settings files.
FIXED = re.compile(r"\s*(\||#{1,6}\s|<|\[[^\]]+\]:\s|- \[[^\]]+\]\([^)\s]+\)$|shellcheck |!|---|===|@)")
SETTING = re.compile(r"\s*([\w.-]+ = |\[[\w.-]+\]$)")


def words_of(text):
    """Words. A code span of up to 60 characters counts as one, and markup stays with the word before it."""
    spans = lambda m: m[0].replace(" ", "\0") if len(m[0]) <= 60 else m[0]
    words = []
    for word in re.sub(r"(?<!`)`[^`]+`(?!`)", spans, text).split():
        if words and MARK.match(word):
            words[-1] += f"\0{word}"
        else:
            words.append(word)
    return words


def fill(words, first, rest):
    """Lines of at most WIDTH columns: the first begins with `first`, the others with `rest`."""
    lines, line = [], first
    empty = True
    for word in words:
        if not empty and len(line) + 1 + len(word) > WIDTH:
            lines.append(line)
            line, empty = rest, True
        line += word if empty else f" {word}"
        empty = False
    return [text.replace("\0", " ") for text in [*lines, line]]


def wrap(lines, lead):
    """Wraps the paragraphs of a block of prose; every line begins with `lead` (indentation and comment marker)."""
    out, paragraph, fenced = [], [], False

    def flush():
        if paragraph and any(len(lead + text) > WIDTH for text in paragraph):
            item = ITEM.match(paragraph[0])
            indent = re.match(r"\s*", paragraph[0])[0]
            first = lead + (item[0] if item else indent)
            rest = lead + (" " * len(item[0]) if item else indent)
            body = paragraph[0][len(item[0]):] if item else paragraph[0]
            out.extend(fill(words_of(" ".join([body, *paragraph[1:]])), first, rest))
        else:
            out.extend(lead + text for text in paragraph)
        paragraph.clear()

    for text in lines:
        fence = re.match(r"\s*(```|~~~)", text)
        if fence or fenced:
            flush()
            out.append(lead + text)
            fenced ^= bool(fence)
            continue
        indent = len(text) - len(text.lstrip())
        item = ITEM.match(text)
        inside = bool(paragraph) and ITEM.match(paragraph[0]) is not None
        setting = lead.strip() == "#" and SETTING.match(text)
        if not text.strip() or FIXED.match(text) or setting or text.endswith(("  ", "\\")):
            flush()
            out.append(lead + text)
        elif item:
            flush()
            paragraph.append(text)
        elif inside and indent >= len(ITEM.match(paragraph[0])[0]):
            paragraph.append(text)
        elif indent > 1:
            # Formulas, columns, and text below an item but outside its first paragraph.
            flush()
            column = column_of(text) if lead.strip() and len(lead + text) > WIDTH else None
            out.extend([lead + text] if column is None else
                       fill(words_of(text[column:]), lead + text[:column], lead + " " * column))
        else:
            if paragraph and (inside or ends_here(lead, paragraph[-1], text)):
                flush()
            paragraph.append(text)
    flush()
    return out


def column_of(text):
    """The start of the last column of an indented line; None without columns, in formulas and in diagrams."""
    gaps = [m.end() for m in re.finditer(r"(?:(?<=\S) {2,}|^ {12,})(?=\S)", text[:60])]
    return gaps[-1] if gaps and not re.search(r" = |exp\(", text) and not DRAWN.search(text) else None


def ends_here(lead, line, following):
    """Whether a line was broken on purpose: a sentence ends, and the next word would have fitted easily."""
    return line.endswith((".", ":", ";")) and len(lead + line) + 1 + len(following.split()[0]) <= WIDTH - 25


def rust_starts(text):
    """For each line of Rust: whether it begins in code, not in a string or a block comment."""
    starts, i, depth = [True], 0, 0
    while i < len(text):
        if depth:
            mark = text[i:i + 2]
            depth += (mark == "/*") - (mark == "*/")
            step = 2 if mark in ("/*", "*/") else 1
        elif text.startswith("//", i):
            step = (text.find("\n", i) if "\n" in text[i:] else len(text)) - i
        elif text.startswith("/*", i):
            depth, step = 1, 2
        elif m := re.compile(r'\b[bc]?r(#*)"').match(text, i):
            end = text.find(f'"{m[1]}', m.end())
            step = (len(text) if end < 0 else end + 1 + len(m[1])) - i
        elif text[i] == '"':
            m = re.compile(r'"(?:[^"\\]|\\.)*"?', re.DOTALL).match(text, i)
            step = m.end() - i
        elif m := re.compile(r"b?'(?:[^'\\\n]|\\[^\n]+?)'").match(text, i):
            step = m.end() - i
        else:
            step = 1
        piece = text[i:i + step]
        code = depth == 0 and step == 1
        starts.extend([code] * piece.count("\n"))
        i += max(step, 1)
    return starts


def hash_starts(path, text):
    """For each line of Python, shell or TOML: whether a `#` there begins a comment that fills the line."""
    lines = text.split("\n")
    if path.suffix == ".py":
        comments = {token.start[0] for token in tokenize.generate_tokens(io.StringIO(text).readline)
                    if token.type == tokenize.COMMENT}
        return [n in comments for n in range(1, len(lines) + 1)]
    starts, heredoc, inside = [], None, None
    for line in lines:
        starts.append(heredoc is None and inside is None)
        if heredoc is not None:
            heredoc = None if line.strip() == heredoc else heredoc
        elif inside is not None:
            inside = None if line.count(inside) % 2 else inside
        elif line.lstrip().startswith("#"):
            pass
        elif path.suffix == ".toml":
            inside = next((mark for mark in ('"""', "'''") if line.count(mark) % 2), None)
        elif m := re.search(r"<<-?\s*(['\"]?)(\w+)\1", line):
            heredoc = m[2]
        elif re.sub(r'"(?:[^"\\]|\\.)*"|\'[^\']*\'|\\.', "", line).count("'") % 2:
            inside = "'"
    return starts


def comment_of(path, line):
    """Lead and text of a line that is only a comment; None for every other line."""
    if path.suffix in (".rs", ".wgsl", ".proto"):
        m = re.match(r"(\s*)(//[/!]?)(?!/)(.*)$", line)
    else:
        m = re.match(r"(\s*)(#)(?![!#])(.*)$", line)
    if not m or (m[3] and not m[3].startswith(" ")):
        return None
    return m[1] + m[2], m[3]


def rewrapped(path, text):
    """The text of a file with wrapped comments, or with wrapped prose for Markdown."""
    lines = text.split("\n")
    if path.suffix == ".md":
        front = 0
        if lines[0] == "---" and "---" in lines[1:]:
            front = lines.index("---", 1) + 1
        return "\n".join([*lines[:front], *wrap(lines[front:], "")])
    starts = rust_starts(text) if path.suffix in (".rs", ".wgsl", ".proto") else hash_starts(path, text)
    out, block, lead = [], [], None

    def flush():
        # One space belongs to the marker; an empty comment line has none.
        texts = [body[1:] for body in block]
        out.extend(line.rstrip() if not line[len(lead):].strip() else line for line in wrap(texts, f"{lead} "))
        block.clear()

    for line, start in zip(lines, starts, strict=True):
        found = comment_of(path, line) if start else None
        if block and (found is None or found[0] != lead):
            flush()
        if found is None:
            out.append(line)
        else:
            lead = found[0]
            block.append(found[1])
    if block:
        flush()
    return "\n".join(out)


def essence(path, text):
    """The parts that must stay: the code line by line, and all words of the comments between two lines of code."""
    parts = [""]
    for line in text.split("\n"):
        found = ("", line) if path.suffix == ".md" else comment_of(path, line)
        if found is None:
            parts += [line, ""]
        else:
            parts[-1] += " ".join(["", *found[1].split()])
    return parts


def long_lines(text):
    return sum(len(line) > WIDTH for line in text.split("\n"))


def run(paths, write):
    changed = before = after = 0
    for path in paths:
        text = path.read_text(encoding="utf-8")
        new = rewrapped(path, text)
        if essence(path, new) != essence(path, text):
            sys.exit(f"rewrap: {path}: words or code would change; nothing is written there")
        before, after = before + long_lines(text), after + long_lines(new)
        if new != text:
            changed += 1
            print(f"{path.relative_to(ROOT) if path.is_relative_to(ROOT) else path}: "
                  f"{long_lines(text)} long lines, {long_lines(new)} afterwards")
            if write:
                path.write_text(new, encoding="utf-8")
    print(f"rewrap: {changed} files, {before} lines beyond {WIDTH} columns, {after} afterwards")
    return changed


def self_check():
    long = "word " * 30
    cases = [
        # Suffix, before, after (None: as before).
        (".rs", f"/// {long.strip()}\n/// more\nfn f() {{}}\n",
         "/// " + "word " * 20 + "word\n/// " + "word " * 8 + "word more\nfn f() {}\n"),
        (".rs", f"/// short line\n/// that stays\n\n    // {'a' * 100}\n", None),
        (".rs", f"/// - {long.strip()}\n///   more\n/// - b\n",
         "/// - " + "word " * 20 + "word\n///   " + "word " * 8 + "word more\n/// - b\n"),
        (".rs", f"/// ```\n/// {long.strip()}\n/// ```\n/// | {long.strip()} |\n///   a ──► {long.strip()}\n", None),
        (".wgsl", f"//   state [4]  vec4: {long.strip()}\n//              end\n//   b     [5]  c\n// text\n",
         "//   state [4]  vec4: " + "word " * 16 + "word\n//              " + "word " * 12 + "word\n//              end\n//   b     [5]  c\n// text\n"),
        (".rs", f'let s = r#"\n// {long.strip()}\n"#;\nlet t = "a\\\n// {long.strip()}\n";\n', None),
        (".rs", f"let c = '\"'; // {long.strip()}\nlet l: &'static str = \"\";\n/* \n// {long.strip()}\n*/\n", None),
        (".rs", f"//! {'x' * 104} - `a b`\n", f"//! {'x' * 104} -\n//! `a b`\n"),
        (".rs", f"//! {'x' * 90} `one two three four`\n", f"//! {'x' * 90}\n//! `one two three four`\n"),
        (".rs", f"/// Shape [N].\n/// {long.strip()}\n", "/// Shape [N].\n/// " + "word " * 20 + "word\n/// " + "word " * 8 + "word\n"),
        (".sh", f"#!/bin/sh {long.strip()}\npython3 - <<'PY'\n# {long.strip()}\nPY\nx='a\n# {long.strip()}\n'\n", None),
        (".sh", f"# {long.strip()}\n", "# " + "word " * 20 + "word\n# " + "word " * 8 + "word\n"),
        (".toml", f"# {long.strip()}\n# key = 1\n# [section]\n# more\n",
         "# " + "word " * 20 + "word\n# " + "word " * 8 + "word\n# key = 1\n# [section]\n# more\n"),
        (".py", f'x = """\n# {long.strip()}\n"""\n', None),
        (".toml", f"a = '''\n# {long.strip()}\n'''\n", None),
        (".md", f"# {long.strip()}\n\n| {long.strip()} |\n\n```\n{long.strip()}\n```\n", None),
        (".md", f"{long.strip()}\nend\n", "word " * 21 + "word\n" + "word " * 7 + "word end\n"),
        (".md", f"1. {long.strip()}\n   end\n", "1. " + "word " * 20 + "word\n   " + "word " * 8 + "word end\n"),
    ]
    for suffix, text, wanted in cases:
        path = Path(f"made_up{suffix}")
        new = rewrapped(path, text)
        assert new == (text if wanted is None else wanted), f"{text}\nbecame\n{new}"
        assert rewrapped(path, new) == new, f"{text}\nis wrapped again"
        assert essence(path, new) == essence(path, text), text
    assert essence(Path("a.rs"), "// a b\nc\n") != essence(Path("a.rs"), "// a\nc // b\n")
    print(f"rewrap: {len(cases)} test files are wrapped correctly")


def tracked():
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return [ROOT / name for name in names if name.endswith((".rs", ".wgsl", ".proto", ".toml", ".sh", ".py", ".md"))]


def main():
    arguments = sys.argv[1:]
    if arguments == ["--self-check"]:
        return self_check()
    check = arguments[:1] == ["--check"]
    names = arguments[check:]
    if any(name.startswith("-") for name in names):
        sys.exit(__doc__)
    changed = run([Path(name).resolve() for name in names] or tracked(), write=not check)
    return sys.exit(1 if check and changed else 0)


if __name__ == "__main__":
    main()
