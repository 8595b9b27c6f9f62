//! The files of a dataset as one blob: a line `DIGEST BYTES PATH` for each, by ascending path.
//!
//! ```text
//! 17f3…c2 1048576 images/0001.jpg
//! 90ab…07 2097152 images/0002.jpg
//! ```
//!
//! DIGEST is BLAKE3 in 64 lower-case hex digits, BYTES a decimal number, one space stands between the three, `\n` ends every
//! line, the last one too, and paths ascend by their bytes in UTF-8. One set of files therefore has one text, and the BLAKE3 of this text
//! is the root digest of the dataset.

use std::collections::{HashMap, HashSet};
use std::fmt::Write as _;

use fathom_core::paths::check_inside;
use fathom_core::scene::BlobRef;
use icu_normalizer::ComposingNormalizerBorrowed;

/// Faults that are told of one list; who has made thousands wants to see a few.
const MAX_FAULTS: usize = 100;

/// One file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListedFile {
    /// Its path in the dataset.
    pub path: String,
    /// Its content.
    pub blob: BlobRef,
}

/// Why a file cannot be in a dataset.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileFault {
    /// Its place in what was handed in, from 0.
    pub index: usize,
    /// "path" or "blob".
    pub of: &'static str,
    /// What is wrong, with the path.
    pub message: String,
}

/// The files of a dataset, at least one, by ascending path.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileList {
    files: Vec<ListedFile>,
    bytes: u64,
}

impl FileList {
    /// The list of these files, in whatever order they come.
    ///
    /// # Errors
    /// What is wrong with which of them, at most a hundred faults. Paths are relative and plain
    /// ([`fathom_core::paths::check_inside`]), in Unicode's form NFC, and different; none is the folder of another. Two that differ in
    /// case are two.
    pub fn new(files: Vec<ListedFile>) -> Result<Self, Vec<FileFault>> {
        let mut faults = Vec::new();
        let mut fault = |index, of, message: String| {
            if faults.len() < MAX_FAULTS {
                faults.push(FileFault { index, of, message });
            }
        };
        if files.is_empty() {
            fault(0, "path", "there is none: a dataset has at least one file".into());
        }
        let nfc = ComposingNormalizerBorrowed::new_nfc();
        let (mut paths, mut lengths, mut bytes) = (HashSet::new(), HashMap::new(), 0_u64);
        for (index, ListedFile { path, blob }) in files.iter().enumerate() {
            let shown: String = path.chars().take(80).collect();
            if let Err(what) = check_inside(path) {
                fault(index, "path", format!("{shown:?} {what}"));
            } else if !nfc.is_normalized(path) {
                fault(index, "path", format!("{shown:?} is not in Unicode's form NFC; normalise it"));
            } else if !paths.insert(path.as_str()) {
                fault(index, "path", format!("{shown:?} is there twice"));
            }
            if !blob.is_well_formed() {
                let digest: String = blob.digest.chars().take(80).collect();
                fault(
                    index,
                    "blob",
                    format!("{shown:?} has {digest:?} for a digest, which is 64 lower-case hex digits"),
                );
            } else if *lengths.entry(blob.digest.as_str()).or_insert(blob.bytes) != blob.bytes {
                fault(
                    index,
                    "blob",
                    format!("{shown:?} has a digest that has another length at another file"),
                );
            }
            match bytes.checked_add(blob.bytes) {
                Some(sum) => bytes = sum,
                None => fault(index, "blob", format!("{shown:?} has more bytes than can be")),
            }
        }
        for (index, ListedFile { path, .. }) in files.iter().enumerate() {
            let folders = path.match_indices('/').map(|(end, _)| &path[..end]);
            if let Some(file) = folders.into_iter().find(|folder| paths.contains(folder)) {
                let [path, file] = [path, file].map(|text| text.chars().take(80).collect::<String>());
                fault(index, "path", format!("{path:?} lies in {file:?}, which is a file"));
            }
        }
        if !faults.is_empty() {
            return Err(faults);
        }
        let mut files = files;
        files.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(Self { files, bytes })
    }

    /// Reads the text of a list.
    ///
    /// # Errors
    /// When it is none, or not in the one form that its files have.
    pub fn parse(text: &[u8]) -> Result<Self, String> {
        let text = std::str::from_utf8(text).map_err(|error| format!("is no text: {error}"))?;
        let mut files = Vec::new();
        for (index, line) in text.split_terminator('\n').enumerate() {
            let file = || {
                let (digest, rest) = line.split_once(' ')?;
                let (bytes, path) = rest.split_once(' ')?;
                let blob = BlobRef { digest: digest.to_owned(), bytes: bytes.parse().ok()? };
                Some(ListedFile { path: path.to_owned(), blob })
            };
            files.push(file().ok_or_else(|| format!("line {} is not DIGEST BYTES PATH", index + 1))?);
        }
        let list = Self::new(files).map_err(|faults| match faults.first() {
            Some(fault) => format!("line {}: {}", fault.index + 1, fault.message),
            None => "is no list of files".to_owned(),
        })?;
        if list.to_text() != text {
            return Err("is not in the form of such lists: sorted by path, plain numbers, a newline behind every line".into());
        }
        Ok(list)
    }

    /// Its text; the BLAKE3 of it is the root digest.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        for ListedFile { path, blob } in &self.files {
            // Writing to a String cannot fail.
            let _ = writeln!(text, "{} {} {path}", blob.digest, blob.bytes);
        }
        text
    }

    /// Its files, by ascending path.
    pub fn files(&self) -> &[ListedFile] {
        &self.files
    }

    /// The bytes of all of them, each by itself.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Different blobs, each with the first of its files.
    pub fn blobs(&self) -> Vec<&ListedFile> {
        let mut seen = HashSet::new();
        self.files.iter().filter(|file| seen.insert(file.blob.digest.as_str())).collect()
    }

    /// The file with this path.
    pub fn find(&self, path: &str) -> Option<&ListedFile> {
        self.files.binary_search_by(|file| file.path.as_str().cmp(path)).ok().map(|index| &self.files[index])
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
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
        let text = sorted.to_text();
        let [a, b, c] =
            ["a.jpg", "b.jpg", "b/täuchung.jpg"].map(|path| blake3::hash(path.as_bytes()).to_hex());
        assert_eq!(text, format!("{a} 5 a.jpg\n{b} 5 b.jpg\n{c} 15 b/täuchung.jpg\n"), "the documented form");
        assert_eq!(FileList::parse(text.as_bytes()), Ok(sorted.clone()));
        assert_eq!((sorted.bytes(), sorted.files().len()), (25, 3));
        assert_eq!(sorted.find("b.jpg"), Some(&file("b.jpg")));
        assert_eq!(sorted.find("b"), None);
    }

    #[test]
    fn every_file_that_cannot_be_there_is_named_with_the_reason() {
        let decomposed = "ta\u{308}uchung.jpg";
        let paths =
            ["good.jpg", "../x", "/etc/passwd", "a\\b", "a\0b", decomposed, "good.jpg", "good.jpg/x", ""];
        let faults = list(&paths).unwrap_err();
        let told: Vec<(usize, &str)> = faults.iter().map(|fault| (fault.index, fault.of)).collect();
        assert_eq!(told, [1, 2, 3, 4, 5, 6, 8, 7].map(|index| (index, "path")), "{faults:#?}");
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
                .contains("more bytes")
        );
        assert_eq!(with(good).unwrap().blobs().len(), 1);
    }

    #[test]
    fn a_text_in_any_other_form_is_no_list() {
        let text = list(&["a", "b"]).unwrap().to_text();
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
            assert!(FileList::parse(wrong.as_bytes()).is_err(), "{wrong:?}");
        }
        assert!(FileList::parse(b"\xff").is_err());
    }
}
