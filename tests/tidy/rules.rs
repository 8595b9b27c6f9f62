//! Keeps the repository in order: lines, sentences, words, paths, sizes and lint exceptions.
//!
//! Each check is a test. A failure names file and line, and says what to do. The checks themselves are tested
//! on small strings below.
//!
//! Only the standard library is used: `rustc --edition 2024 --test tests/tidy/main.rs` compiles it in a
//! second.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Columns of a comment line and of a line of Markdown prose, as `rustfmt.toml` has them for code.
const COLUMNS: usize = 110;
/// Words of a sentence.
const WORDS: usize = 30;
/// Lines of a Rust file.
const LINES: usize = 600;
/// Characters of the name of a function: tests are sentences, but short ones.
const NAME: usize = 60;

/// Documents with a limit of their own, in bytes.
const SIZES: &[(&str, usize)] =
    &[("README.md", 6_000), ("ARCHITECTURE.md", 15_000), ("BENCHMARKS.md", 10_000)];

/// Phrases and names that were replaced: the old one and the new one. With a space in it, a phrase is found
/// in any case and over line breaks; a name is found as a whole.
const PHRASES: &[(&str, &str)] = &[
    ("the one that your workers are done with soonest", "the partitioning predicted to finish soonest"),
    ("shows where its scene was cut stands in", "`metrics.json` reports whether borders are visible"),
    ("what no photograph can tell", "Photographs cannot determine ..."),
    ("what nothing hides is black", "rays that hit nothing are black"),
    ("whoever is about to refer to a blob", "Before referencing a blob, callers check that it exists"),
    ("who has none can come with a token", "Without a certificate, worker tokens are rejected"),
    ("so many times as long", "this many times longer than its siblings"),
    ("has had the memory for its next task", "Fail a job after this long without a worker that ..."),
    ("of what it is said to be at most", "the limit for this type is ..."),
    ("what the mean alpha lacks to 1", "`1 - alpha`, averaged over ..."),
    ("comes no further", "stops, or fails"),
    ("whoever", "a subject: callers, users, whatever acts"),
    ("told", "report"),
    ("handed in", "submit"),
    ("is said to", "the fact itself, or who reports it"),
    ("nine numbers", "the water parameters"),
    ("usual viewing distance", "the scene scale"),
    ("usual viewing distances", "scene scales"),
    ("DESIGN.md", "docs/, since DESIGN.md is not in the repository"),
    ("DESIGN section", "docs/, since DESIGN.md is not in the repository"),
    ("fathom workers", "fathom worker list"),
    ("Refinement", "RangeModulation"),
    ("borders.refine", "borders.enabled"),
    ("Truth", "TargetImages"),
    ("OwnPixels", "LossMask"),
    ("Way", "RenderOptions"),
    ("Show::Seen", "Output::Underwater"),
    ("Show::Clear", "Output::Restored"),
    ("Show::Veil", "Output::Backscatter"),
    ("haste", "lr_scale"),
    ("heir", "successor"),
    ("Trainer::refine", "densify"),
    ("BlockTraining.refine", "density_stats"),
    ("kills/bench.rs", "kills/harness.rs"),
    ("an_attempt_is_slow_after_three_times", "attempt_is_slow_at_3x_median_of_siblings"),
    ("make_again", "requeue_lost"),
    ("keep_house", "collect_garbage"),
    ("Lack", "Shortfall"),
    ("Need", "Requirements"),
    ("Touched", "RowsNeeded"),
    ("Dump", "Export"),
    ("steer.rs", "job_control.rs"),
    ("water.partitions = refine", "water.partitions = joint"),
    ("Stage::Refine", "Stage::WaterRefine"),
    ("TASK_KIND_REFINE", "TASK_KIND_WATER_REFINE"),
    ("core::frame", "core::axes"),
    ("fn tell", "fn events"),
    ("pipeline.rs", "own_tasks/run.rs"),
    ("launcher.rs", "own_tasks/run.rs"),
    ("Shared", "State"),
    ("Peer", "WorkerProfile"),
    ("Bench", "TestCluster or Harness; benchmarks go to benches/"),
    ("water.from", "water.start_at"),
    ("water.until", "water.freeze_at"),
    ("plain_colours", "sh0_while_free"),
    ("water.saturation", "water.overwhite_weight"),
    ("water.decay", "water.l2_weight"),
    ("water.floaters", "water.floater_weight"),
    ("alpha_surface", "surface_alpha_weight"),
    ("train.noise", "train.mean_noise"),
    ("far_field", "background_gaussians"),
];

/// Ends of files that are read; all others (pictures, `Cargo.lock`, `bench/history.jsonl`) are not prose.
const TEXTS: &[&str] = &["rs", "wgsl", "proto", "toml", "sh", "py", "md"];
/// Files whose sentences `make settings` takes from the source, where they are checked.
const GENERATED: &[&str] = &[
    "docs/using/settings.md",
    "deploy/job.example.toml",
    "deploy/coordinator.example.toml",
    "deploy/worker.example.toml",
];
/// Words whose full stop ends no sentence.
const ABBREVIATIONS: &[&str] = &[
    "e.g.", "i.e.", "eq.", "eqs.", "fig.", "sec.", "vs.", "cf.", "al.", "approx.", "no.", "resp.", "ca.",
    "p.", "pp.",
];

#[test]
fn comments_and_prose_fit_the_columns() {
    let found = in_all(TEXTS, long_lines);
    none(&found, "run scripts/rewrap.py");
}

#[test]
fn sentences_are_short() {
    let found = in_all(&["md", "rs", "proto"], long_sentences);
    none(&found, "make two sentences of it");
}

#[test]
fn replaced_phrases_stay_away() {
    let texts = all_joined();
    let found = PHRASES.iter().flat_map(|&(old, new)| {
        let say = move |found: Finding| Finding { what: format!("{}; say: {new}", found.what), ..found };
        phrase_everywhere(&texts, old).into_iter().map(say)
    });
    none(&found.collect::<Vec<_>>(), "use the words of PHRASES in tests/tidy/rules.rs");
}

#[test]
fn links_and_paths_of_documents_exist() {
    let tracked = tracked();
    let found = in_all(&["md"], |file, text| dead_paths(file, text, &tracked));
    none(&found, "correct the path, or take it out");
}

#[test]
fn anchors_of_links_are_headings() {
    let documents = texts(&["md"]);
    let headings: BTreeMap<&str, BTreeSet<String>> =
        documents.iter().map(|(file, text)| (file.as_str(), anchors(text))).collect();
    let found: Vec<_> =
        documents.iter().flat_map(|(file, text)| dead_anchors(file, text, &headings)).collect();
    none(&found, "link to a heading that is there");
}

#[test]
fn documents_keep_their_size() {
    for &(file, most) in SIZES {
        let Ok(text) = std::fs::read(root().join(file)) else {
            panic!("{file} is missing; SIZES in tests/tidy/rules.rs names it")
        };
        assert!(
            text.len() <= most,
            "{file} has {} bytes, at most {most}: move what is not for every reader to docs/ or bench/",
            text.len()
        );
    }
}

#[test]
fn exceptions_from_lints_have_a_reason() {
    let found = in_all(&["rs"], exceptions_without_reason);
    none(&found, "add `reason = \"...\"`, and prefer #[expect] to #[allow]");
}

#[test]
fn files_of_rust_are_short() {
    let found = in_all(&["rs"], |file, text| long_file(file, text, LINES));
    none(&found, "split the file where its story does");
}

#[test]
fn names_of_functions_are_short() {
    let found = in_all(&["rs"], long_names);
    none(&found, "say less in the name, and the rest in the test");
}

/// A place that a check complains about.
#[derive(Debug, PartialEq)]
struct Finding {
    file: String,
    line: usize,
    what: String,
}

fn finding(file: &str, line: usize, what: impl Into<String>) -> Finding {
    Finding { file: file.to_owned(), line, what: what.into() }
}

/// Fails with all places and what to do, if there are any.
fn none(found: &[Finding], advice: &str) {
    let places: Vec<_> = found.iter().map(|f| format!("{}:{}: {}", f.file, f.line, f.what)).collect();
    assert!(found.is_empty(), "{} places; {advice}:\n{}", found.len(), places.join("\n"));
}

/// The folder of the workspace: the first one above that has a `Cargo.lock`.
fn root() -> PathBuf {
    let start = option_env!("CARGO_MANIFEST_DIR")
        .map_or_else(|| std::env::current_dir().expect("a folder"), PathBuf::from);
    let found = start.ancestors().find(|folder| folder.join("Cargo.lock").is_file());
    found.expect("tidy runs in the repository").to_owned()
}

/// All files that git knows and that are there.
fn tracked() -> BTreeSet<String> {
    let done =
        Command::new("git").args(["ls-files", "-z"]).current_dir(root()).output().expect("tidy needs git");
    assert!(done.status.success(), "git ls-files: {}", String::from_utf8_lossy(&done.stderr));
    let names = String::from_utf8(done.stdout).expect("names in UTF-8");
    let names: BTreeSet<_> =
        names.split_terminator('\0').filter(|name| root().join(name).is_file()).map(str::to_owned).collect();
    assert!(names.len() > 100, "git knows {} files; is this the repository?", names.len());
    names
}

fn extension(file: &str) -> &str {
    Path::new(file).extension().and_then(|end| end.to_str()).unwrap_or("")
}

/// Files with one of these ends, and their text. This file is not among them: it holds what it looks for.
fn texts(ends: &[&str]) -> Vec<(String, String)> {
    let files = tracked()
        .into_iter()
        .filter(|file| ends.contains(&extension(file)) && !file.ends_with("tidy/rules.rs"));
    let texts: Vec<_> = files
        .map(|file| {
            let text =
                std::fs::read_to_string(root().join(&file)).unwrap_or_else(|error| panic!("{file}: {error}"));
            (file, text)
        })
        .collect();
    assert!(!texts.is_empty(), "no file ends with {ends:?}");
    texts
}

fn in_all(ends: &[&str], check: impl Fn(&str, &str) -> Vec<Finding>) -> Vec<Finding> {
    texts(ends).iter().flat_map(|(file, text)| check(file, text)).collect()
}

/// The text of a line that is a comment and nothing else, without its marker; `None` for code.
fn comment<'a>(file: &str, line: &'a str) -> Option<&'a str> {
    let line = line.trim_start();
    if matches!(extension(file), "rs" | "wgsl" | "proto") {
        let text = line.strip_prefix("//")?;
        return Some(text.strip_prefix(['/', '!']).unwrap_or(text));
    }
    line.strip_prefix('#').filter(|text| !text.starts_with('!'))
}

/// Comment lines and lines of prose beyond [`COLUMNS`]. Tables, URLs, code blocks and diagrams may be longer.
fn long_lines(file: &str, text: &str) -> Vec<Finding> {
    let (mut found, mut fenced) = (Vec::new(), false);
    for (n, line) in text.lines().enumerate() {
        let prose = if extension(file) == "md" { Some(line) } else { comment(file, line) };
        let Some(prose) = prose.map(str::trim_start) else {
            fenced = false;
            continue;
        };
        if prose.starts_with("```") {
            fenced = !fenced;
            continue;
        }
        // A list of contents, where every item is one link, cannot be wrapped.
        let is_link = prose.starts_with("- [") && prose.ends_with(".md)");
        let is_whole = prose.starts_with('|') || line.contains("://") || prose.starts_with("![");
        let free = fenced || is_link || is_whole;
        let columns = line.chars().count();
        if columns > COLUMNS && !free && !line.contains(['─', '│', '►', '└', '┘']) {
            found.push(finding(file, n + 1, format!("{columns} columns, at most {COLUMNS}")));
        }
    }
    found
}

/// Paragraphs, items and headings of Markdown or of the doc comments of Rust and proto, each with its first
/// line.
fn paragraphs(file: &str, text: &str) -> Vec<(usize, String)> {
    let mut out = Vec::new();
    let mut current: Option<(usize, String)> = None;
    let mut fenced = false;
    for (n, line) in text.lines().enumerate() {
        let prose = match extension(file) {
            "md" => Some(line),
            "rs" => ["///", "//!"].iter().find_map(|marker| line.trim_start().strip_prefix(marker)),
            _ => comment(file, line),
        };
        let Some(prose) = prose else {
            fenced = false;
            out.extend(current.take());
            continue;
        };
        let bare = prose.trim();
        if bare.starts_with("```") {
            fenced = !fenced;
            out.extend(current.take());
            continue;
        }
        let code = fenced || (current.is_none() && prose.starts_with("     "));
        if code || bare.is_empty() || bare.starts_with(['|', '#', '<']) {
            out.extend(current.take());
            continue;
        }
        if is_item(bare) {
            out.extend(current.take());
        }
        let (_, said) = current.get_or_insert((n + 1, String::new()));
        said.push_str(bare);
        said.push('\n');
    }
    out.extend(current);
    out
}

/// Whether a line begins an item of a list: `- `, `* `, `+ `, `1. `, `1) `.
fn is_item(line: &str) -> bool {
    let number = line.trim_start_matches(|c: char| c.is_ascii_digit());
    ["- ", "* ", "+ "].iter().any(|mark| line.starts_with(mark))
        || (number.len() < line.len() && (number.starts_with(". ") || number.starts_with(") ")))
}

/// Sentences of a paragraph, each with how many lines further down it begins.
fn sentences(paragraph: &str) -> Vec<(usize, String)> {
    let text = without_code(paragraph);
    let chars: Vec<(usize, char)> = text.char_indices().collect();
    let (mut out, mut start) = (Vec::new(), 0);
    for (i, &(at, c)) in chars.iter().enumerate() {
        let closing = |&&(_, c): &&(usize, char)| matches!(c, '"' | '\'' | ')' | ']' | '*' | '_');
        let mut after = chars[i + 1..].iter().skip_while(closing);
        let space = after.next();
        let next = after.map(|&(_, c)| c).find(|c| !c.is_whitespace());
        let ends = matches!(c, '.' | '?' | '!')
            && space.is_none_or(|(_, c)| c.is_whitespace())
            && next.is_none_or(|c| !c.is_lowercase())
            && !(c == '.' && is_abbreviation(&text[start..=at]));
        if ends {
            let end = space.map_or(text.len(), |&(at, _)| at);
            out.push(start..end);
            start = end;
        }
    }
    out.push(start..text.len());
    let said = out.into_iter().map(|range| {
        let sentence = text[range.clone()].trim_start();
        (text[..range.end - sentence.len()].matches('\n').count(), sentence.trim_end().to_owned())
    });
    said.filter(|(_, sentence)| !sentence.is_empty()).collect()
}

/// Code spans as one word, and links as their text alone.
fn without_code(text: &str) -> String {
    let (mut out, mut rest) = (String::new(), text);
    while let Some(at) = rest.find(['`', ']']) {
        out.push_str(&rest[..at]);
        let ticks = rest[at..].chars().take_while(|&c| c == '`').count();
        let (skip, word) = if ticks > 0 {
            let mark = &rest[at..at + ticks];
            let inner = rest[at + ticks..].find(mark);
            // Lines are counted, so breaks inside of the span stay.
            let breaks = inner.map_or(0, |end| rest[at..at + ticks + end].matches('\n').count());
            (inner.map_or(ticks, |end| end + 2 * ticks), format!("CODE{}", "\n".repeat(breaks)))
        } else if rest[at..].starts_with("](") {
            (rest[at..].find(')').map_or(1, |end| end + 1), String::new())
        } else {
            (1, "]".to_owned())
        };
        out.push_str(&word);
        rest = &rest[at + skip..];
    }
    out + rest
}

fn is_abbreviation(sentence: &str) -> bool {
    let word = sentence.split_whitespace().last().unwrap_or("").trim_start_matches(['(', '[', '"']);
    ABBREVIATIONS.contains(&word.to_lowercase().as_str())
        || word.chars().count() == 2 && word.starts_with(char::is_uppercase)
}

fn words(sentence: &str) -> usize {
    sentence.split_whitespace().filter(|word| word.contains(char::is_alphanumeric)).count()
}

fn long_sentences(file: &str, text: &str) -> Vec<Finding> {
    let mut found = Vec::new();
    if GENERATED.contains(&file) {
        return found;
    }
    for (line, paragraph) in paragraphs(file, text) {
        for (below, sentence) in
            sentences(&paragraph).into_iter().filter(|(_, sentence)| words(sentence) > WORDS)
        {
            let start: Vec<_> = sentence.split_whitespace().take(8).collect();
            let what = format!("{} words, at most {WORDS}: \"{} ...\"", words(&sentence), start.join(" "));
            found.push(finding(file, line + below, what));
        }
    }
    found
}

/// The words of a file with single spaces between them and without comment markers.
struct Joined {
    text: String,
    lower: String,
    /// Where each line begins in the text, and its number.
    lines: Vec<(usize, usize)>,
}

fn joined(text: &str) -> Joined {
    let (mut out, mut lines) = (String::with_capacity(text.len()), Vec::new());
    for (n, line) in text.lines().enumerate() {
        lines.push((out.len(), n + 1));
        let line =
            line.trim().trim_start_matches("//").trim_start_matches(['/', '!', '#']).trim_end_matches('\\');
        for word in line.split_whitespace() {
            out.push_str(word);
            out.push(' ');
        }
    }
    Joined { lower: out.to_ascii_lowercase(), text: out, lines }
}

/// Where a phrase or a name stands, as whole words.
fn phrase(file: &str, joined: &Joined, wanted: &str) -> Vec<Finding> {
    let is_phrase = wanted.contains(' ');
    let text = if is_phrase { &joined.lower } else { &joined.text };
    let wanted_text = if is_phrase { wanted.to_ascii_lowercase() } else { wanted.to_owned() };
    let part = |c: Option<char>| c.is_some_and(char::is_alphanumeric);
    let open = !part(wanted.chars().next_back());
    let mut found = Vec::new();
    for (at, _) in text.match_indices(&wanted_text) {
        let after = text[at + wanted_text.len()..].chars().next();
        if !part(text[..at].chars().next_back()) && (open || !part(after)) {
            let line = joined.lines.partition_point(|&(start, _)| start <= at);
            found.push(finding(file, joined.lines[line - 1].1, format!("\"{wanted}\"")));
        }
    }
    found
}

fn all_joined() -> Vec<(String, Joined)> {
    let written = texts(TEXTS).into_iter().filter(|(file, _)| !GENERATED.contains(&file.as_str()));
    written.map(|(file, text)| (file, joined(&text))).collect()
}

fn phrase_everywhere(texts: &[(String, Joined)], wanted: &str) -> Vec<Finding> {
    texts.iter().flat_map(|(file, joined)| phrase(file, joined, wanted)).collect()
}

/// Relative links, and paths in backticks, that lead nowhere.
fn dead_paths(file: &str, text: &str, tracked: &BTreeSet<String>) -> Vec<Finding> {
    let folder = Path::new(file).parent().unwrap_or(Path::new(""));
    let exists = |path: &str| {
        let path = path.trim_end_matches('/');
        tracked.contains(path)
            || tracked.range(format!("{path}/")..).next().is_some_and(|f| f.starts_with(&format!("{path}/")))
    };
    let beside = |path: &str| exists(&normalised(&folder.join(path)));
    let named = |path: &str| tracked.iter().any(|f| f.ends_with(&format!("/{path}")));
    let (mut found, mut fenced) = (Vec::new(), false);
    for (n, line) in text.lines().enumerate() {
        if line.trim_start().starts_with("```") {
            fenced = !fenced;
        }
        if fenced {
            continue;
        }
        for (at, _) in line.match_indices("](") {
            let target = line[at + 2..].split([')', ' ', '#']).next().unwrap_or("");
            if !target.is_empty() && !target.contains(':') && !beside(target) {
                found.push(finding(file, n + 1, format!("the link to {target} leads nowhere")));
            }
        }
        for path in line.split('`').skip(1).step_by(2).filter(|code| is_path(code, tracked)) {
            if !exists(path) && !beside(path) && !named(path) {
                found.push(finding(file, n + 1, format!("there is no {path}")));
            }
        }
    }
    found
}

/// The anchors of a document's headings, as forges and mdBook make them.
fn anchors(text: &str) -> BTreeSet<String> {
    let (mut found, mut fenced) = (BTreeSet::new(), false);
    for line in text.lines() {
        fenced ^= line.trim_start().starts_with("```");
        let heading = line.trim_start_matches('#');
        if !fenced && heading.len() < line.len() && heading.starts_with(' ') {
            let kept = heading.trim().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
            found.insert(kept.collect::<String>().to_lowercase().replace(' ', "-"));
        }
    }
    found
}

/// Links to a part of a document that has no such heading.
fn dead_anchors(file: &str, text: &str, headings: &BTreeMap<&str, BTreeSet<String>>) -> Vec<Finding> {
    let folder = Path::new(file).parent().unwrap_or(Path::new(""));
    let (mut found, mut fenced) = (Vec::new(), false);
    for (n, line) in text.lines().enumerate() {
        fenced ^= line.trim_start().starts_with("```");
        let links = line.match_indices("](").filter(|_| !fenced);
        for (at, _) in links {
            let link = line[at + 2..].split([')', ' ']).next().unwrap_or("");
            let Some((path, anchor)) = link.split_once('#').filter(|(path, _)| !path.contains(':')) else {
                continue;
            };
            let target = if path.is_empty() { file.to_owned() } else { normalised(&folder.join(path)) };
            // That the document exists is checked apart.
            if headings.get(target.as_str()).is_some_and(|of_it| !of_it.contains(anchor)) {
                found.push(finding(file, n + 1, format!("{target} has no heading for #{anchor}")));
            }
        }
    }
    found
}

/// Whether a code span looks like a path of the repository: by its end, or by its first folder.
fn is_path(code: &str, tracked: &BTreeSet<String>) -> bool {
    let plain = code.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c))
        && !code.starts_with(['.', '/', '-']);
    // A bare name of another kind may be a file of another project.
    let ends: &[&str] = if code.contains('/') { TEXTS } else { &["rs", "wgsl"] };
    let source = ends.contains(&extension(code));
    let top = code.split_once('/').map(|(top, rest)| (format!("{top}/"), rest));
    let inside =
        top.is_some_and(|(top, rest)| !rest.is_empty() && tracked.iter().any(|file| file.starts_with(&top)));
    plain && (source || inside)
}

/// A path without `.` and `..`.
fn normalised(path: &Path) -> String {
    let mut parts: Vec<&str> = Vec::new();
    for part in path.iter().filter_map(|part| part.to_str()) {
        match part {
            "." => {}
            ".." => drop(parts.pop()),
            _ => parts.push(part),
        }
    }
    parts.join("/")
}

/// `allow` and `expect` of lints without a reason.
fn exceptions_without_reason(file: &str, text: &str) -> Vec<Finding> {
    let mut found = Vec::new();
    for marker in ["#[allow(", "#![allow(", "#[expect(", "#![expect(", "cfg_attr("] {
        for (at, _) in text.match_indices(marker) {
            let line_start = text[..at].rfind('\n').map_or(0, |n| n + 1);
            let whole = &text[at..at + text[at..].find(")]").unwrap_or(text.len() - at)];
            let lint = marker != "cfg_attr(" || whole.contains("allow(") || whole.contains("expect(");
            if lint && !whole.contains("reason") && !text[line_start..at].contains(['"', '/']) {
                found.push(finding(file, text[..at].matches('\n').count() + 1, whole.replace('\n', " ")));
            }
        }
    }
    found
}

fn long_file(file: &str, text: &str, most: usize) -> Vec<Finding> {
    let lines = text.lines().count();
    if lines > most {
        vec![finding(file, lines, format!("{lines} lines, at most {most}"))]
    } else {
        Vec::new()
    }
}

fn long_names(file: &str, text: &str) -> Vec<Finding> {
    let mut found = Vec::new();
    for (n, line) in text.lines().enumerate() {
        let name = line.trim_start().split_once("fn ").map_or("", |(before, rest)| {
            let is_code = before
                .split_whitespace()
                .all(|word| word.starts_with("pub") || word == "async" || word == "const");
            if is_code { rest.split(['(', '<']).next().unwrap_or("") } else { "" }
        });
        if name.chars().count() > NAME {
            found.push(finding(
                file,
                n + 1,
                format!("{} characters, at most {NAME}: {name}", name.chars().count()),
            ));
        }
    }
    found
}

#[path = "checks_of_the_checks.rs"]
mod checks_of_the_checks;
