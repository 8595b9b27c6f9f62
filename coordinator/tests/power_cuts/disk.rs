//! The possible states of a disk after a power cut.
//!
//! A file certainly has the writes from before the begin of its last completed sync, and a folder the names
//! from before the begin of its last completed sync. Everything later is lost, kept, or kept in part, in
//! sectors, in any order. sync_file_range does not count: it syncs neither lengths nor the disk's own cache.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use crate::record::{FileId, Op, Recording};

/// Atomic unit of a disk write, bytes.
const SECTOR: u64 = 512;

/// Pseudo-random numbers from a seed (splitmix64).
pub struct Random(pub u64);

impl Random {
    pub fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % end
    }
}

/// The fate of unsynced writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// All of them are kept, as after a kill of the process.
    Kept,
    /// None of them is kept.
    Lost,
    /// The disk wrote in order, and stopped somewhere.
    InOrder,
    /// Each piece independently is kept, is lost, or is kept in some of its sectors.
    Any,
}

impl Fate {
    pub const ALL: [Self; 4] = [Self::Kept, Self::Lost, Self::InOrder, Self::Any];
}

/// Files and folders of a disk.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Image {
    pub folders: BTreeSet<PathBuf>,
    pub files: BTreeMap<PathBuf, Vec<u8>>,
}

impl Image {
    pub fn read(root: &Path) -> Self {
        let mut image = Self::default();
        let mut folders = vec![root.to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                let name = path.strip_prefix(root).unwrap().to_owned();
                if path.is_dir() {
                    folders.push(path);
                    image.folders.insert(name);
                } else {
                    image.files.insert(name, std::fs::read(&path).unwrap());
                }
            }
        }
        image
    }

    pub fn write(&self, root: &Path) {
        std::fs::create_dir_all(root).unwrap();
        // In order of names: outer folders first.
        for folder in &self.folders {
            std::fs::create_dir(root.join(folder)).unwrap();
        }
        for (name, bytes) in &self.files {
            std::fs::write(root.join(name), bytes).unwrap();
        }
    }
}

#[derive(Clone)]
enum Data {
    Write { offset: u64, bytes: Vec<u8> },
    SetLength(u64),
}

#[derive(Clone)]
enum Naming {
    MakeFolder(PathBuf),
    Create(PathBuf, FileId),
    Rename(PathBuf, PathBuf, FileId),
    Unlink(PathBuf),
}

impl Naming {
    fn folder(&self) -> &Path {
        let (Self::MakeFolder(name) | Self::Create(name, _) | Self::Rename(_, name, _) | Self::Unlink(name)) =
            self;
        name.parent().unwrap_or(Path::new(""))
    }
}

#[derive(Clone, Default)]
struct File {
    safe: Vec<u8>,
    /// In order, each with its number.
    open: Vec<(usize, Data)>,
}

/// A disk on which a recording is replayed, step by step.
pub struct Disk {
    files: HashMap<FileId, File>,
    names: BTreeMap<PathBuf, FileId>,
    folders: BTreeSet<PathBuf>,
    open: Vec<(usize, Naming)>,
    /// Started syncs: the file or folder, and the number of writes before it.
    syncs: HashMap<u32, (Result<FileId, PathBuf>, usize)>,
    done: usize,
}

impl Disk {
    /// The state at the start of the recording; all of it is durable.
    pub fn new(begin: &Image, recording: &Recording) -> Self {
        let names: BTreeMap<_, _> = recording.begin.iter().cloned().collect();
        let files = names
            .iter()
            .map(|(name, file)| (*file, File { safe: begin.files[name].clone(), open: Vec::new() }));
        let files = files.collect();
        Self {
            files,
            names,
            folders: begin.folders.clone(),
            open: Vec::new(),
            syncs: HashMap::new(),
            done: 0,
        }
    }

    /// Replays the next step.
    pub fn step(&mut self, op: &Op) {
        let number = self.done;
        self.done += 1;
        let mut data = |file: FileId, data| self.files.entry(file).or_default().open.push((number, data));
        match op.clone() {
            Op::Write { file, offset, bytes } => data(file, Data::Write { offset, bytes }),
            Op::SetLength { file, length } => data(file, Data::SetLength(length)),
            Op::MakeFolder { name } => self.open.push((number, Naming::MakeFolder(name))),
            Op::Create { name, file } => self.open.push((number, Naming::Create(name, file))),
            Op::Rename { from, to, file } => self.open.push((number, Naming::Rename(from, to, file))),
            Op::Unlink { name } => self.open.push((number, Naming::Unlink(name))),
            Op::SyncBegins { file, sync } => drop(self.syncs.insert(sync, (Ok(file), number))),
            Op::SyncFolderBegins { folder, sync } => drop(self.syncs.insert(sync, (Err(folder), number))),
            Op::SyncEnds { sync } => match self.syncs.remove(&sync) {
                Some((Ok(file), before)) => self.make_safe(file, before),
                Some((Err(folder), before)) => {
                    let is_safe = |(at, naming): &(usize, Naming)| *at < before && naming.folder() == folder;
                    let (safe, open) = std::mem::take(&mut self.open).into_iter().partition(is_safe);
                    self.open = open;
                    let safe: Vec<(usize, Naming)> = safe;
                    for (_, naming) in &safe {
                        name(&mut self.names, &mut self.folders, naming);
                    }
                }
                None => {}
            },
            Op::Acknowledged(_) => {}
        }
    }

    fn make_safe(&mut self, file: FileId, before: usize) {
        let File { safe, open } = self.files.entry(file).or_default();
        let (now_safe, rest): (Vec<_>, Vec<_>) =
            std::mem::take(open).into_iter().partition(|(at, _)| *at < before);
        now_safe.iter().for_each(|(_, data)| change(safe, data));
        *open = rest;
    }

    /// A possible state if power fails now.
    pub fn image(&self, fate: Fate, random: &mut Random) -> Image {
        // The point where an in-order disk has stopped.
        let all = self
            .open
            .iter()
            .map(|(at, _)| *at)
            .chain(self.files.values().flat_map(|file| file.open.iter().map(|(at, _)| *at)));
        let first = all.min().unwrap_or(self.done);
        let stopped = first + random.below((self.done - first + 1) as u64) as usize;
        let (mut names, mut folders) = (self.names.clone(), self.folders.clone());
        for (at, naming) in &self.open {
            let is_kept = match fate {
                Fate::Kept => true,
                Fate::Lost => false,
                Fate::InOrder => *at < stopped,
                Fate::Any => random.below(2) == 0,
            };
            if is_kept {
                name(&mut names, &mut folders, naming);
            }
        }
        let mut image = Image { folders, ..Image::default() };
        let has_parents = |path: &Path, folders: &BTreeSet<PathBuf>| {
            path.ancestors().skip(1).all(|parent| parent.as_os_str().is_empty() || folders.contains(parent))
        };
        let folders = image.folders.clone();
        image.folders.retain(|folder| has_parents(folder, &folders));
        for (name, file) in names {
            if !has_parents(&name, &image.folders) {
                continue;
            }
            let file = self.files.get(&file).cloned().unwrap_or_default();
            let mut bytes = file.safe;
            for (at, data) in &file.open {
                match fate {
                    Fate::Kept => change(&mut bytes, data),
                    Fate::Lost => {}
                    Fate::InOrder if *at < stopped => change(&mut bytes, data),
                    Fate::InOrder if *at == stopped => tear(&mut bytes, data, random),
                    Fate::InOrder => {}
                    Fate::Any => match random.below(3) {
                        0 => change(&mut bytes, data),
                        1 => tear(&mut bytes, data, random),
                        _ => {}
                    },
                }
            }
            image.files.insert(name, bytes);
        }
        image
    }
}

fn name(names: &mut BTreeMap<PathBuf, FileId>, folders: &mut BTreeSet<PathBuf>, naming: &Naming) {
    match naming {
        Naming::MakeFolder(name) => drop(folders.insert(name.clone())),
        Naming::Create(name, file) => drop(names.insert(name.clone(), *file)),
        Naming::Rename(from, to, file) => {
            names.remove(from);
            names.insert(to.clone(), *file);
        }
        Naming::Unlink(name) => drop(names.remove(name)),
    }
}

fn change(bytes: &mut Vec<u8>, data: &Data) {
    match data {
        Data::Write { offset, bytes: written } => put(bytes, *offset as usize, written),
        Data::SetLength(length) => bytes.resize(*length as usize, 0),
    }
}

fn put(bytes: &mut Vec<u8>, offset: usize, written: &[u8]) {
    let end = offset + written.len();
    if bytes.len() < end {
        bytes.resize(end, 0);
    }
    bytes[offset..end].copy_from_slice(written);
}

/// Some sectors of a write.
fn tear(bytes: &mut Vec<u8>, data: &Data, random: &mut Random) {
    let Data::Write { offset, bytes: written } = data else { return };
    let end = offset + written.len() as u64;
    let mut at = *offset;
    while at < end {
        let next = end.min((at / SECTOR + 1) * SECTOR);
        if random.below(2) == 0 {
            put(bytes, at as usize, &written[(at - offset) as usize..(next - offset) as usize]);
        }
        at = next;
    }
}
