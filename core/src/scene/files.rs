//! Finds photographs and masks on disk.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use icu_normalizer::ComposingNormalizerBorrowed;

use crate::paths::check_inside;
use crate::{CoreError, Result};

/// The entries of a folder by ascending name; none if the folder does not exist.
pub(super) fn sorted_entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error)
            if matches!(error.kind(), std::io::ErrorKind::NotFound | std::io::ErrorKind::NotADirectory) =>
        {
            return Ok(Vec::new());
        }
        Err(source) => return Err(CoreError::Io { action: "read", path: folder.to_owned(), source }),
    };
    let mut paths = Vec::new();
    for entry in entries {
        paths.push(entry.map_err(CoreError::io("read", folder))?.path());
    }
    paths.sort();
    Ok(paths)
}

/// All files below a folder by their relative path in lower case and in Unicode's form NFC, `/` between
/// folders. Systems differ in both: a Mac writes "é" as two characters.
///
/// If names differ in case or form only, the first by name wins.
pub(super) struct FileIndex {
    files: BTreeMap<String, PathBuf>,
}

impl FileIndex {
    pub fn of(folder: &Path) -> Result<Self> {
        // Deeper than any dataset; stops at circular links.
        const MAX_DEPTH: usize = 16;
        let mut files = BTreeMap::new();
        let mut open = vec![(folder.to_owned(), String::new(), 0)];
        while let Some((folder, prefix, depth)) = open.pop() {
            for path in sorted_entries(&folder)? {
                let Some(name) = path.file_name().and_then(|name| name.to_str()) else { continue };
                let key = format!("{prefix}{}", folded(name));
                if path.is_dir() {
                    if depth < MAX_DEPTH {
                        open.push((path, format!("{key}/"), depth + 1));
                    }
                } else {
                    files.entry(key).or_insert(path);
                }
            }
        }
        Ok(Self { files })
    }

    pub fn is_empty(&self) -> bool {
        self.files.is_empty()
    }

    pub fn get(&self, relative: &str) -> Option<&Path> {
        self.files.get(&folded(relative)).map(PathBuf::as_path)
    }

    /// The mask of the photograph `name`: `img.jpg.png` as COLMAP writes, `img.png`, `img.mask.png`, or its
    /// own name.
    pub fn mask_of(&self, name: &str) -> Option<&Path> {
        let stem = stem(name);
        [format!("{name}.png"), format!("{stem}.png"), format!("{stem}.mask.png"), name.to_owned()]
            .iter()
            .find_map(|candidate| self.get(candidate))
    }
}

fn folded(name: &str) -> String {
    ComposingNormalizerBorrowed::new_nfc().normalize(name).to_lowercase()
}

/// A name without its extension.
fn stem(name: &str) -> &str {
    let file = name.rfind('/').map_or(0, |at| at + 1);
    match name[file..].rfind('.') {
        Some(dot) if dot > 0 => &name[..file + dot],
        _ => name,
    }
}

/// Refuses unsafe names of photographs, because they become parts of paths on other machines.
pub(super) fn check_name(name: &str) -> Result<(), String> {
    check_inside(name).map_err(|fault| {
        // Only the beginning of a long name is shown.
        let shown: String = name.chars().take(80).collect();
        format!("\"{}\" cannot be the name of a photograph: it {fault}", shown.escape_debug())
    })
}

/// Converts a path of the input to a name: `/` between folders, without `.` and `..`.
pub(super) fn name_of(path: &str) -> String {
    path.split(['/', '\\']).filter(|part| !matches!(*part, "" | "." | "..")).collect::<Vec<_>>().join("/")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unsafe_names_are_refused_and_long_ones_are_shortened() {
        assert_eq!(check_name("left cam/frame 12.JPG"), Ok(()));
        assert!(check_name("a/../../b.jpg").is_err_and(|fault| fault.contains("without \"..\"")));
        assert!(check_name(&"a".repeat(1 << 20)).is_err_and(|fault| fault.len() < 200));
    }

    #[test]
    fn a_file_is_found_under_any_spelling_of_its_name() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("r\u{e9}cif")).unwrap();
        std::fs::write(folder.path().join("r\u{e9}cif/Caf\u{e9}.JPG"), "x").unwrap();
        let index = FileIndex::of(folder.path()).unwrap();
        for name in ["r\u{e9}cif/caf\u{e9}.jpg", "re\u{301}cif/Cafe\u{301}.JPG"] {
            assert!(index.get(name).is_some_and(Path::is_file), "{name:?}");
        }
        assert_eq!(index.get("recif/Cafe.JPG"), None);
    }

    #[test]
    fn a_path_becomes_a_name_with_slashes() {
        assert_eq!(name_of("./images/0001.png"), "images/0001.png");
        assert_eq!(name_of("..\\rig\\left\\a b.png"), "rig/left/a b.png");
    }

    #[test]
    fn stems_keep_their_folder() {
        assert_eq!(stem("a.b/img.jpg"), "a.b/img");
        assert_eq!(stem("a.b/img"), "a.b/img");
        assert_eq!(stem("a.b/.hidden"), "a.b/.hidden");
    }
}
