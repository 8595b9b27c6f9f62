//! The files of a dataset as one blob: a line `DIGEST BYTES PATH` for each, by ascending path.
//!
//! ```text
//! 17f3…c2 1048576 images/0001.jpg
//! 90ab…07 2097152 images/0002.jpg
//! ```
//!
//! DIGEST is BLAKE3 in 64 lower-case hex digits, BYTES a decimal number. One space separates the fields, `\n`
//! ends every line, also the last one, and paths ascend by their UTF-8 bytes. So a set of files has exactly
//! one text, and the BLAKE3 of this text is the root digest of the dataset.

use std::collections::{HashMap, HashSet};
use std::fmt::Write as _;

use fathom_core::paths::check_inside;
use fathom_core::scene::BlobRef;
use icu_normalizer::ComposingNormalizerBorrowed;

/// Maximum faults reported for one list; a few of thousands are enough.
const MAX_FAULTS: usize = 100;

/// One file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListedFile {
    /// Its path in the dataset.
    pub path: String,
    /// Its content.
    pub blob: BlobRef,
}

/// Why a dataset cannot have a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileFault {
    /// Its index in the submitted list, from 0.
    pub index: usize,
    /// "path" or "blob".
    pub of: &'static str,
    /// The fault, with the path.
    pub message: String,
}

/// The files of a dataset, at least one, by ascending path. Stored as its text plus 4 bytes a file, because
/// there may be millions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileList {
    text: String,
    /// Offsets of its lines.
    starts: Vec<u32>,
    bytes: u64,
}

/// One line of a list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileEntry<'a> {
    /// Its path in the dataset.
    pub path: &'a str,
    /// BLAKE3 of its content, 64 hex digits.
    pub digest: &'a str,
    /// Its length.
    pub bytes: u64,
}

impl FileEntry<'_> {
    /// Its content.
    pub fn blob(&self) -> BlobRef {
        BlobRef { digest: self.digest.to_owned(), bytes: self.bytes }
    }
}

impl FileList {
    /// The list of these files, given in any order.
    ///
    /// # Errors
    /// At most a hundred faults of single files. Paths are relative and plain
    /// ([`fathom_core::paths::check_inside`]), in Unicode's form NFC, and different; none is the folder of
    /// another. Two that differ in case are two.
    pub fn new(files: Vec<ListedFile>) -> Result<Self, Vec<FileFault>> {
        let mut faults = Vec::new();
        let mut fault = |index, of, message: String| {
            if faults.len() < MAX_FAULTS {
                faults.push(FileFault { index, of, message });
            }
        };
        if files.is_empty() {
            fault(0, "path", NO_FILE.into());
        }
        let nfc = ComposingNormalizerBorrowed::new_nfc();
        let (mut paths, mut lengths, mut bytes) = (HashSet::new(), HashMap::new(), 0_u64);
        for (index, ListedFile { path, blob }) in files.iter().enumerate() {
            if let Some(what) = fault_of_path(&nfc, path) {
                fault(index, "path", what);
            } else if !paths.insert(path.as_str()) {
                fault(index, "path", format!("{:?} appears twice", shown(path)));
            }
            if !blob.is_well_formed() {
                let what = format!(
                    "{:?} has the digest {:?}; a digest is 64 lower-case hex digits",
                    shown(path),
                    shown(&blob.digest)
                );
                fault(index, "blob", what);
            } else if *lengths.entry(blob.digest.as_str()).or_insert(blob.bytes) != blob.bytes {
                fault(index, "blob", other_length(path));
            }
            match bytes.checked_add(blob.bytes) {
                Some(sum) => bytes = sum,
                None => fault(index, "blob", too_many_bytes(path)),
            }
        }
        for (index, ListedFile { path, .. }) in files.iter().enumerate() {
            if let Some(file) = folders(path).find(|folder| paths.contains(folder)) {
                fault(index, "path", lies_in(path, file));
            }
        }
        if !faults.is_empty() {
            return Err(faults);
        }
        let mut files = files;
        files.sort_by(|a, b| a.path.cmp(&b.path));
        let (mut text, mut starts) = (String::new(), Vec::with_capacity(files.len()));
        for ListedFile { path, blob } in &files {
            // The files of one message are far below 4 GiB.
            starts.push(text.len() as u32);
            // Writing to a String cannot fail.
            let _ = writeln!(text, "{} {} {path}", blob.digest, blob.bytes);
        }
        Ok(Self { text, starts, bytes })
    }

    /// Parses the text of a list, without a copy.
    ///
    /// # Errors
    /// When it is not a list, or not in canonical form.
    pub fn parse(text: Vec<u8>) -> Result<Self, String> {
        let text = String::from_utf8(text).map_err(|error| format!("is not a text: {error}"))?;
        if text.is_empty() {
            return Err(NO_FILE.into());
        }
        let other_form = || {
            "is not in canonical form: sorted by path, plain numbers, a newline after every line".to_owned()
        };
        if u32::try_from(text.len()).is_err() {
            return Err("has more than 4 GiB".into());
        }
        let nfc = ComposingNormalizerBorrowed::new_nfc();
        let (mut starts, mut bytes, mut before, mut start) = (Vec::new(), 0_u64, None, 0);
        for (index, line) in text.split_terminator('\n').enumerate() {
            let wrong = |what: String| format!("line {}: {what}", index + 1);
            let file = line_of(line).ok_or_else(|| format!("line {} is not DIGEST BYTES PATH", index + 1))?;
            let is_plain = line.len() == 66 + file.bytes.to_string().len() + file.path.len();
            if let Some(what) = fault_of_path(&nfc, file.path) {
                return Err(wrong(what));
            } else if !file.blob().is_well_formed() {
                return Err(wrong(format!("{:?} is not a digest", shown(file.digest))));
            } else if before == Some(file.path) {
                return Err(wrong(format!("{:?} appears twice", shown(file.path))));
            } else if !is_plain || before.is_some_and(|before| before > file.path) {
                return Err(other_form());
            }
            bytes = file.bytes.checked_add(bytes).ok_or_else(|| wrong(too_many_bytes(file.path)))?;
            starts.push(start as u32);
            start += line.len() + 1;
            before = Some(file.path);
        }
        if !text.ends_with('\n') {
            return Err(other_form());
        }
        let list = Self { text, starts, bytes };
        for (index, file) in list.files().enumerate() {
            if let Some(folder) = folders(file.path).find(|folder| list.find(folder).is_some()) {
                return Err(format!("line {}: {}", index + 1, lies_in(file.path, folder)));
            }
        }
        let by_digest = list.by_digest();
        let differs = by_digest.windows(2).find(|pair| {
            let [a, b] = [list.line(pair[0]), list.line(pair[1])];
            a.digest == b.digest && a.bytes != b.bytes
        });
        match differs {
            Some(pair) => Err(format!("line {}: {}", pair[1] + 1, other_length(list.line(pair[1]).path))),
            None => Ok(list),
        }
    }

    /// Its text; the BLAKE3 of it is the root digest.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The text, by value.
    pub fn into_text(self) -> String {
        self.text
    }

    /// Number of files.
    pub fn count(&self) -> u64 {
        self.starts.len() as u64
    }

    /// Its files, by ascending path.
    pub fn files(&self) -> impl ExactSizeIterator<Item = FileEntry<'_>> {
        (0..self.starts.len() as u32).map(|index| self.line(index))
    }

    /// Sum of the lengths of all files; equal files count each.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Distinct blobs, each with the first of its files.
    pub fn blobs(&self) -> impl ExactSizeIterator<Item = FileEntry<'_>> {
        let mut firsts = self.by_digest();
        firsts.dedup_by_key(|index| self.line(*index).digest);
        firsts.sort_unstable();
        firsts.into_iter().map(|index| self.line(index))
    }

    /// The file with this path.
    pub fn find(&self, path: &str) -> Option<FileEntry<'_>> {
        let found = self.starts.binary_search_by(|start| self.line_at(*start).path.cmp(path));
        found.ok().map(|index| self.line_at(self.starts[index]))
    }

    /// Indices of its lines, sorted by digest, then by path.
    fn by_digest(&self) -> Vec<u32> {
        let mut lines: Vec<u32> = (0..self.starts.len() as u32).collect();
        lines.sort_unstable_by_key(|index| (self.line(*index).digest, *index));
        lines
    }

    fn line(&self, index: u32) -> FileEntry<'_> {
        self.line_at(self.starts[index as usize])
    }

    fn line_at(&self, start: u32) -> FileEntry<'_> {
        let rest = &self.text[start as usize..];
        let line = rest.split_once('\n').map_or(rest, |(line, _)| line);
        // Every line was verified when the list was made.
        line_of(line).unwrap_or(FileEntry { path: "", digest: "", bytes: 0 })
    }
}

const NO_FILE: &str = "is empty: a dataset has at least one file";

fn line_of(line: &str) -> Option<FileEntry<'_>> {
    let (digest, rest) = line.split_once(' ')?;
    let (bytes, path) = rest.split_once(' ')?;
    Some(FileEntry { path, digest, bytes: bytes.parse().ok()? })
}

/// A text, shortened for messages.
fn shown(text: &str) -> String {
    text.chars().take(80).collect()
}

fn fault_of_path(nfc: &ComposingNormalizerBorrowed<'_>, path: &str) -> Option<String> {
    if let Err(what) = check_inside(path) {
        Some(format!("{:?} {what}", shown(path)))
    } else if !nfc.is_normalized(path) {
        Some(format!("{:?} is not in Unicode's form NFC; normalise it", shown(path)))
    } else {
        None
    }
}

/// The folders that a path lies in.
fn folders(path: &str) -> impl Iterator<Item = &str> {
    path.match_indices('/').map(|(end, _)| &path[..end])
}

fn lies_in(path: &str, file: &str) -> String {
    format!("{:?} lies in {:?}, which is a file", shown(path), shown(file))
}

fn other_length(path: &str) -> String {
    format!("{:?} has the digest of a file with another length", shown(path))
}

fn too_many_bytes(path: &str) -> String {
    format!("{:?} has an impossible length", shown(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: &str) -> ListedFile {
        ListedFile { path: path.into(), blob: BlobRef::of(path.as_bytes()) }
    }

    fn list(paths: &[&str]) -> Result<FileList, Vec<FileFault>> {
        FileList::new(paths.iter().map(|path| file(path)).collect())
    }

    #[test]
    fn a_set_of_files_has_one_text_and_with_it_one_root_digest() {
        let sorted = list(&["a.jpg", "b/täuchung.jpg", "b.jpg"]).unwrap();
        assert_eq!(list(&["b.jpg", "b/täuchung.jpg", "a.jpg"]).unwrap(), sorted);
        let text = sorted.text().to_owned();
        let [a, b, c] =
            ["a.jpg", "b.jpg", "b/täuchung.jpg"].map(|path| blake3::hash(path.as_bytes()).to_hex());
        assert_eq!(text, format!("{a} 5 a.jpg\n{b} 5 b.jpg\n{c} 15 b/täuchung.jpg\n"), "the documented form");
        assert_eq!(FileList::parse(text.into_bytes()), Ok(sorted.clone()));
        assert_eq!((sorted.bytes(), sorted.count()), (25, 3));
        let digest = b.to_string();
        assert_eq!(sorted.find("b.jpg"), Some(FileEntry { path: "b.jpg", digest: &digest, bytes: 5 }));
        assert_eq!(sorted.find("b"), None);
    }

    #[test]
    fn every_invalid_file_is_named_with_the_reason() {
        let decomposed = "ta\u{308}uchung.jpg";
        let paths =
            ["good.jpg", "../x", "/etc/passwd", "a\\b", "a\0b", decomposed, "good.jpg", "good.jpg/x", ""];
        let faults = list(&paths).unwrap_err();
        let found: Vec<(usize, &str)> = faults.iter().map(|fault| (fault.index, fault.of)).collect();
        assert_eq!(found, [1, 2, 3, 4, 5, 6, 8, 7].map(|index| (index, "path")), "{faults:#?}");
        for (fault, reason) in faults.iter().zip([
            "\"..\"",
            "absolute",
            "backslash",
            "control",
            "NFC",
            "twice",
            "empty",
            "is a file",
        ]) {
            assert!(fault.message.contains(reason), "{fault:?}");
        }
        assert!(list(&["x"; 5000]).unwrap_err().len() <= MAX_FAULTS);
        assert!(list(&[&"x".repeat(1025)]).unwrap_err()[0].message.contains("1025 bytes"));
        assert!(list(&[]).unwrap_err()[0].message.contains("at least one file"));
        assert!(list(&["A.jpg", "a.jpg"]).is_ok(), "two that differ in case are two");

        let with = |blob: BlobRef| FileList::new(vec![file("a"), ListedFile { path: "b".into(), blob }]);
        let good = BlobRef::of(b"a");
        let upper = BlobRef { digest: good.digest.to_uppercase(), ..good.clone() };
        assert_eq!(with(upper).unwrap_err()[0].of, "blob");
        assert!(
            with(BlobRef { bytes: 7, ..good.clone() }).unwrap_err()[0].message.contains("another length")
        );
        assert!(
            with(BlobRef { bytes: u64::MAX, ..BlobRef::of(b"b") }).unwrap_err()[0]
                .message
                .contains("impossible length")
        );
        let twice = with(good).unwrap();
        assert_eq!(twice.blobs().map(|file| file.path).collect::<Vec<_>>(), ["a"]);
    }

    #[test]
    fn a_text_in_any_other_form_is_no_list() {
        let text = list(&["a", "b"]).unwrap().into_text();
        let lines: Vec<&str> = text.lines().collect();
        let digest = &lines[0][..64];
        for wrong in [
            String::new(),
            text.trim_end().to_owned(),
            format!("{text}\n"),
            format!("{}\n{}\n", lines[1], lines[0]),
            text.replace(" 1 ", " 01 "),
            text.replace(" 1 ", " +1 "),
            text.replace('\n', "\r\n"),
            format!("{text}{digest} 1\n"),
            format!("{text}{digest} x c\n"),
        ] {
            assert!(FileList::parse(wrong.clone().into_bytes()).is_err(), "{wrong:?}");
        }
        assert!(FileList::parse(b"\xff".to_vec()).is_err());
        let [a, folder] =
            [lines[0].to_owned(), lines[0].replace(" a", " a/b")].map(|line| format!("{line}\n"));
        let between = lines[0].replace(" a", " a-b");
        let said = FileList::parse(format!("{a}{between}\n{folder}").into_bytes()).unwrap_err();
        assert!(said.starts_with("line 3: \"a/b\" lies in \"a\""), "{said}");
        let said =
            FileList::parse(format!("{a}{}\n", lines[0].replace(" 1 a", " 2 b")).into_bytes()).unwrap_err();
        assert!(said.starts_with("line 2: ") && said.contains("another length"), "{said}");
        assert!(FileList::parse(format!("{a}{a}").into_bytes()).unwrap_err().contains("twice"));
    }
}
