//! Reads the settings of a job from the source of `core::config`: keys, types and doc comments.
//!
//! It parses only the Rust that this folder uses: structs with public fields, and enums of plain variants.

use std::collections::BTreeMap;
use std::path::Path;

/// The structs and enums of `core/src/config`, by name.
#[derive(Default)]
pub struct Source {
    structs: BTreeMap<String, Struct>,
    enums: BTreeMap<String, Vec<Variant>>,
}

#[derive(Clone, Default)]
pub struct Struct {
    pub doc: String,
    pub fields: Vec<Field>,
}

#[derive(Clone)]
pub struct Field {
    pub key: String,
    pub of: String,
    pub doc: String,
}

/// A variant of an enum, as it is written in a file.
#[derive(Clone)]
pub struct Variant {
    name: String,
    pub word: String,
    pub doc: String,
}

impl Source {
    /// Reads all files of a folder.
    pub fn read(folder: &Path) -> Self {
        let mut source = Self::default();
        for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
            if entry.path().extension().is_some_and(|end| end == "rs") {
                source.add(&std::fs::read_to_string(entry.path()).unwrap());
            }
        }
        source
    }

    fn add(&mut self, text: &str) {
        let (mut doc, mut attributes) = (String::new(), String::new());
        let mut lines = text.lines();
        while let Some(line) = lines.next() {
            if let Some(text) = line.strip_prefix("///") {
                doc += text;
            } else if line.starts_with("#[") {
                attributes += line;
            } else {
                let name = |rest: &str| rest.trim_end_matches('{').trim().to_owned();
                let body = lines.by_ref().take_while(|line| *line != "}");
                if let Some(rest) = line.strip_prefix("pub struct ") {
                    let of = Struct { doc: plain(&doc), fields: fields(body) };
                    self.structs.insert(name(rest), of);
                } else if let Some(rest) = line.strip_prefix("pub enum ") {
                    self.enums.insert(name(rest), variants(body, &attributes));
                }
                doc.clear();
                attributes.clear();
            }
        }
    }

    pub fn section(&self, name: &str) -> Option<&Struct> {
        self.structs.get(name)
    }

    pub fn values(&self, name: &str) -> Option<&[Variant]> {
        self.enums.get(name).map(Vec::as_slice)
    }

    /// A doc comment for readers who do not know the code: links to items become keys and values.
    pub fn readable(&self, doc: &str) -> String {
        let mut parts = doc.split("[`");
        let mut out = parts.next().unwrap_or_default().to_owned();
        for part in parts {
            let (item, rest) = part.split_once("`]").unwrap_or((part, ""));
            out += &format!("`{}`{rest}", self.meant(item));
        }
        out
    }

    /// `train.lr` for `super::TrainConfig::lr`, `classic` for `Strategy::Classic`, `train` for `TrainConfig`.
    fn meant(&self, item: &str) -> String {
        let mut path = item.rsplit("::");
        let last = path.next().unwrap_or(item);
        let of = path.next().unwrap_or_default();
        let variant = self.enums.get(of).and_then(|all| all.iter().find(|one| one.name == last));
        match (variant, self.path_of("JobConfig", last), self.path_of("JobConfig", of)) {
            (Some(variant), ..) => variant.word.clone(),
            (_, Some(section), _) => section,
            (.., Some(section)) => format!("{section}.{last}"),
            _ => last.to_owned(),
        }
    }

    /// The path of the struct `wanted` within the struct `within`.
    fn path_of(&self, within: &str, wanted: &str) -> Option<String> {
        self.structs.get(within)?.fields.iter().find_map(|field| {
            let below = || Some(format!("{}.{}", field.key, self.path_of(&field.of, wanted)?));
            if field.of == wanted && self.structs.contains_key(wanted) {
                Some(field.key.clone())
            } else {
                below()
            }
        })
    }
}

fn plain(doc: &str) -> String {
    doc.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Items with their doc comments and attributes.
fn items<'a>(body: impl Iterator<Item = &'a str>) -> Vec<(&'a str, String, String)> {
    let (mut found, mut doc, mut attributes) = (Vec::new(), String::new(), String::new());
    for line in body.map(str::trim) {
        if let Some(text) = line.strip_prefix("///") {
            doc += text;
        } else if line.starts_with("#[") {
            attributes += line;
        } else if let Some(item) = line.strip_suffix(',') {
            found.push((item, plain(&std::mem::take(&mut doc)), std::mem::take(&mut attributes)));
        }
    }
    found
}

fn fields<'a>(body: impl Iterator<Item = &'a str>) -> Vec<Field> {
    let field = |(item, doc, attributes): (&str, String, String)| {
        let (key, of) = item.strip_prefix("pub ")?.split_once(": ")?;
        let is_set_by_users = !attributes.contains("serde(skip)");
        is_set_by_users.then(|| Field { key: key.to_owned(), of: of.to_owned(), doc })
    };
    items(body).into_iter().filter_map(field).collect()
}

fn variants<'a>(body: impl Iterator<Item = &'a str>, of_enum: &str) -> Vec<Variant> {
    let variant = |(item, doc, attributes): (&str, String, String)| {
        let renamed = attributes.split_once("rename = \"").and_then(|(_, rest)| rest.split_once('"'));
        let word = match renamed {
            Some((word, _)) => word.to_owned(),
            None if of_enum.contains("snake_case") => snake_case(item),
            None => item.to_lowercase(),
        };
        Variant { name: item.to_owned(), word, doc }
    };
    items(body).into_iter().map(variant).collect()
}

fn snake_case(name: &str) -> String {
    let mut out = String::new();
    for (at, c) in name.chars().enumerate() {
        if at > 0 && c.is_uppercase() {
            out.push('_');
        }
        out.extend(c.to_lowercase());
    }
    out
}

/// A doc comment without its sentence about the default, and the source and notes of that sentence.
pub struct Said {
    pub meaning: String,
    pub source: String,
}

/// Cuts "Default VALUE (SOURCE)." out of a doc comment; `values` is 3 if the default is a list of three.
pub fn said(doc: &str, values: usize) -> Said {
    let Some(start) =
        doc.match_indices("Default").map(|(at, _)| at).find(|at| *at == 0 || doc[..*at].ends_with(". "))
    else {
        return Said { meaning: doc.to_owned(), source: String::new() };
    };
    let end =
        doc[start..].match_indices(". ").map(|(at, _)| start + at).find(|at| ends_sentence(&doc[..=*at]));
    let sentence = doc[start..end.unwrap_or(doc.len())].trim_end_matches('.');
    let rest = end.map_or("", |end| &doc[end + 2..]);
    let meaning = format!("{}{rest}", &doc[..start]).trim().to_owned();
    let ends_value = |(at, c): &(usize, char)| {
        matches!(c, ',' | ';' | ':') && sentence[at + 1..].starts_with(' ')
            || *c == '(' && sentence[..*at].ends_with(' ')
    };
    let after = sentence.char_indices().filter(ends_value).nth(values.saturating_sub(1));
    let note = after.map_or("", |(at, _)| &sentence[at..]).trim_start_matches([',', ';', ':']).trim();
    // The meaning of 0 or 1 goes into the meaning. Values of presets are in the column of defaults.
    let is_of_preset = |clause: &&str| {
        clause.split_once(" in ").is_some_and(|(_, of)| {
            of.trim_start_matches("the preset ").split('`').count() == 3 && of.ends_with('`')
        })
    };
    let is_remark = |clause: &&str| clause.starts_with("0 ") || clause.starts_with("1 ");
    let (remarks, rest): (Vec<&str>, Vec<&str>) = clauses(note)
        .into_iter()
        .filter(|clause| !is_of_preset(clause))
        .partition(|clause| is_remark(clause) && !clause.contains("in `"));
    let first = first_sentence(&meaning).trim_end_matches('.');
    let meaning = match remarks.as_slice() {
        [] => meaning,
        remarks => format!("{first}; {}{}", remarks.join("; "), &meaning[first.len()..]),
    };
    let source = match rest.as_slice() {
        [one] if one.starts_with('(') && one.ends_with(')') && one.matches('(').count() == 1 => {
            one[1..one.len() - 1].to_owned()
        }
        rest => rest.join("; "),
    };
    Said { meaning, source }
}

/// The parts of a text between semicolons that are not in brackets.
fn clauses(text: &str) -> Vec<&str> {
    let mut depth = 0;
    let parts = text.split(|c: char| {
        depth += i32::from(c == '(') - i32::from(c == ')');
        c == ';' && depth == 0
    });
    parts.map(str::trim).filter(|part| !part.is_empty()).collect()
}

/// Whether the full stop at its end ends a sentence.
fn ends_sentence(text: &str) -> bool {
    !["eq.", "e.g.", "al.", "cf."].iter().any(|word| text.ends_with(word))
}

/// The first sentence of a text.
pub fn first_sentence(text: &str) -> &str {
    let end = text.match_indices(". ").map(|(at, _)| at).find(|at| ends_sentence(&text[..=*at]));
    end.map_or(text, |end| &text[..=end])
}

/// The unit of a number, by the words of its doc comment; `before` is the unit of the setting above it.
pub fn unit(of: &str, meaning: &str, before: &str) -> String {
    let sentence = first_sentence(meaning);
    let begins = |words: &str| sentence.starts_with(words);
    let has = |words: &str| sentence.contains(words);
    let is_share = begins("Share") || has("as a share") || has("as shares");
    let unit = match () {
        () if !of.trim_start_matches('[').starts_with(['f', 'u']) => "",
        () if begins("The same") || begins("Rows of it") => return before.to_owned(),
        () if is_share && (has("of the run") || has("Shares of the run")) => "share of the run",
        () if is_share => "share",
        () if begins("Weight of") => "weight",
        () if begins("Learning rate") => "learning rate",
        () if begins("Factor on") => "factor",
        () if has("teration") && of.starts_with('u') => "iterations",
        () if begins("Seconds") => "seconds",
        () if has("GiB") => "GiB",
        () if has("MiB") => "MiB",
        () if begins("Metres") => "metres",
        () if has("pixels") && of.starts_with('u') => "pixels",
        () if has("scene scales") => "scene scales",
        () if has("deviations") => "standard deviations",
        () => "",
    };
    unit.to_owned()
}

#[test]
fn defaults_and_sources_are_cut_out_of_doc_comments() {
    let of = |doc: &str, values: usize| {
        let said = said(doc, values);
        (said.meaning, said.source)
    };
    let pair = |meaning: &str, source: &str| (meaning.to_owned(), source.to_owned());
    assert_eq!(of("A weight. Default 0.2 (3DGS).", 1), pair("A weight.", "3DGS"));
    assert_eq!(of("A share. Default .1, .2, .3 (ours).", 3), pair("A share.", "ours"));
    assert_eq!(
        of("A rate. Default 1.5 (eq. 2 of A); 0 in `paper`. More. And more.", 1),
        pair("A rate. More. And more.", "eq. 2 of A")
    );
    assert_eq!(
        of("A number. Default 3, as in A; 0 never does. More.", 1),
        pair("A number; 0 never does. More.", "as in A")
    );
    assert_eq!(
        of("A. Default 0; 1 in `paper` (ours; none is given).", 1),
        pair("A.", "1 in `paper` (ours; none is given)")
    );
    assert_eq!(of("Whether. Default false: no gain.", 1), pair("Whether.", "no gain"));
    assert_eq!(of("Sides. Default 4. 0 waits.", 1), pair("Sides. 0 waits.", ""));
    assert_eq!(of("Nothing of it.", 1), pair("Nothing of it.", ""));
}

#[test]
fn structs_enums_and_links_are_read() {
    let mut source = Source::default();
    source.add(
        "/// All.\npub struct JobConfig {\n    /// A.\n    pub a: PartConfig,\n}\n\n/// A part.\npub struct PartConfig {\n    \
         /// One\n    /// thing.\n    pub one: u32,\n    #[serde(skip)]\n    pub two: u32,\n}\n\
         #[serde(rename_all = \"snake_case\")]\npub enum Travel {\n    /// By.\n    ByFoot,\n    #[serde(rename = \"3d\")]\n    Fly,\n}\n",
    );
    let part = source.section("PartConfig").unwrap();
    assert_eq!(
        (part.doc.as_str(), part.fields.len(), part.fields[0].doc.as_str()),
        ("A part.", 1, "One thing.")
    );
    let words: Vec<_> = source.values("Travel").unwrap().iter().map(|one| one.word.as_str()).collect();
    assert_eq!(words, ["by_foot", "3d"]);
    assert_eq!(
        source.readable("[`Travel::Fly`], [`super::PartConfig::one`], [`PartConfig`] and [`crate::x::f`]."),
        "`3d`, `a.one`, `a` and `f`."
    );
}
