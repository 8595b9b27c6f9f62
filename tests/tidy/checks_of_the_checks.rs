//! The checks themselves, on small strings.

use super::*;

fn lines_of(found: &[Finding]) -> Vec<usize> {
    found.iter().map(|f| f.line).collect()
}

#[test]
fn long_lines_are_found_in_comments_and_prose_alone() {
    let long = "x ".repeat(60);
    for (file, text, lines) in [
        ("a.rs", format!("/// short\n    // {long}\nlet a = \"{long}\";\n"), vec![2]),
        (
            "a.rs",
            format!("/// ```\n/// {long}\n/// ```\n/// | {long} |\n// https://a.b {long}\n/// {long}"),
            vec![6],
        ),
        ("a.wgsl", format!("//   {long}\nlet a = 1; // {long}\n"), vec![1]),
        ("a.sh", format!("#!/bin/sh {long}\n# {long}\n"), vec![2]),
        ("a.toml", format!("a = \"{long}\"\n# {long}\n"), vec![2]),
        ("a.md", format!("{long}\n\n```\n{long}\n```\n| {long} |\n- {long}\n"), vec![1, 7]),
        ("a.md", format!("- [{long}](a.md)\n- [{long}](a.md) and more\n"), vec![2]),
        ("a.rs", format!("// {}", "ä".repeat(107)), vec![]),
        ("a.rs", format!("// {}", "ä".repeat(108)), vec![1]),
    ] {
        assert_eq!(lines_of(&long_lines(file, &text)), lines, "{text}");
    }
}

#[test]
fn sentences_end_where_they_do() {
    let of = |text: &str| sentences(text).into_iter().map(|(_, s)| s).collect::<Vec<_>>();
    assert_eq!(of("One. Two two? Three!"), ["One.", "Two two?", "Three!"]);
    assert_eq!(
        of("See eq. 9 (cf. Fig. 3), e.g. this. Next."),
        ["See eq. 9 (cf. Fig. 3), e.g. this.", "Next."]
    );
    assert_eq!(of("At .5 and 1.25 of v1.2. Then."), ["At .5 and 1.25 of v1.2.", "Then."]);
    assert_eq!(of("It is `a. B c` here. `d` is code."), ["It is CODE here.", "CODE is code."]);
    assert_eq!(
        of("(In brackets.) \"Quoted.\" A [link. B](c.md) ends."),
        ["(In brackets.)", "\"Quoted.\"", "A [link.", "B ends."]
    );
    assert_eq!(of("By J. Doe et al. in the sea"), ["By J. Doe et al. in the sea"]);
    assert_eq!(of("first. second goes on"), ["first. second goes on"]);
}

#[test]
fn long_sentences_are_found_with_their_line() {
    let long = "Word ".repeat(31);
    let fits = "word ".repeat(29) + "`code of many words`.";
    for (file, text, lines) in [
        ("a.md", format!("Short.\n{long}.\n"), vec![2]),
        ("a.md", format!("{fits}\n\n{fits}\n"), vec![]),
        ("a.md", format!("- {fits}\n- {fits}\n  {long}\n"), vec![3]),
        ("a.md", format!("| {long} |\n\n# {long}\n\n```\n{long}\n```\n"), vec![]),
        ("a.rs", format!("/// {fits}\n/// And {long}.\nfn f() {{}} // {long}\n// {long}\n"), vec![2]),
        ("a.proto", format!("// {long}.\nmessage A {{}}\n"), vec![1]),
    ] {
        assert_eq!(lines_of(&long_sentences(file, &text)), lines, "{text}");
    }
}

#[test]
fn phrases_are_found_over_line_breaks_and_names_as_a_whole() {
    let find = |text: &str, wanted: &str| lines_of(&phrase("a.rs", &joined(text), wanted));
    assert_eq!(find("a\n/// The Six\n/// fish.\n", "six fish"), [2]);
    assert_eq!(find("six  fish, Six fish\n", "six fish"), [1, 1]);
    assert_eq!(find("they peel an eel\n", "eel"), [1]);
    assert_eq!(find("Reef reef Reefs MyReef the_Reef Reef::new\n", "Reef"), [1, 1, 1]);
    assert_eq!(find("sixteen fish", "six fish"), [0; 0]);
}

#[test]
fn dead_links_and_paths_are_found() {
    let tracked = ["docs/a.md", "docs/b/c.md", "core/src/gpu/mod.rs", "README.md"].map(str::to_owned).into();
    let dead =
        |text: &str| dead_paths("docs/a.md", text, &tracked).into_iter().map(|f| f.what).collect::<Vec<_>>();
    assert_eq!(
        dead(
            "[a](b/c.md#x) [b](../README.md) [c](https://a.b) [d](#e) `core/src` `gpu/mod.rs` `out/x` `mod.rs` `gone.py`"
        ),
        [""; 0]
    );
    assert_eq!(dead("[a](c.md)"), ["the link to c.md leads nowhere"]);
    assert_eq!(
        dead("see `core/src/cpu.rs`, `gone.rs`"),
        ["there is no core/src/cpu.rs", "there is no gone.rs"]
    );
    assert_eq!(dead("see `core/tests`, `a.b`, `core/*`, `s/step`"), ["there is no core/tests"]);
    assert_eq!(dead("```\n`gone.rs`\n```"), [""; 0]);
}

#[test]
fn links_to_headings_that_are_not_there_are_found() {
    let text = "# The `a.b` of C, twice\n```\n# no heading\n```\n[x](#the-ab-of-c-twice) [y](#no-heading)\n\
                [z](b.md#d) [w](https://a.b#c)\n";
    let headings = BTreeMap::from([("docs/a.md", anchors(text)), ("docs/b.md", anchors("## D\n"))]);
    let dead: Vec<_> = dead_anchors("docs/a.md", text, &headings).into_iter().map(|f| f.what).collect();
    assert_eq!(dead, ["docs/a.md has no heading for #no-heading"]);
    let dead = dead_anchors("c.md", "[z](docs/b.md#e)", &headings);
    assert_eq!(lines_of(&dead), [1]);
}

#[test]
fn exceptions_without_a_reason_are_found() {
    let of = |text: &str| lines_of(&exceptions_without_reason("a.rs", text));
    assert_eq!(of("#[allow(dead_code)]\nfn f() {}\n#![allow(\n    a,\n    b\n)]\n"), [1, 3]);
    assert_eq!(
        of("#[expect(dead_code, reason = \"x\")]\n#[allow(\n    a,\n    reason = \"y\"\n)]\n"),
        [0; 0]
    );
    assert_eq!(of("#[cfg_attr(test, allow(a))]\n#[cfg_attr(test, derive(Debug))]\n// #[allow(a)]\n"), [1]);
}

#[test]
fn long_files_and_any_finding_fail() {
    assert_eq!(lines_of(&long_file("a.rs", "a\nb\nc\n", 2)), [3]);
    assert!(long_file("a.rs", "a\nb\n", 2).is_empty());
    let names = format!("fn {0}() {{}}\n    async fn a{0}() {{}}\n// the fn a{0}(\n", "b".repeat(60));
    assert_eq!(lines_of(&long_names("a.rs", &names)), [2]);
    none(&[], "mend it");
    let fails = std::panic::catch_unwind(|| none(&[finding("a.rs", 7, "x")], "mend it"));
    let said = fails.expect_err("one is more than none");
    let said = said.downcast_ref::<String>().expect("text");
    assert!(["a.rs:7: x", "mend it"].iter().all(|part| said.contains(part)), "{said}");
}
