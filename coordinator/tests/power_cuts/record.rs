//! Records this process's file operations under one folder, in order.
//!
//! This test binary overrides libc's file functions, which all calls of std and sled use (as the simulation
//! overrides `getrandom`). They call libc's, and record operations on files of the folder. A final check
//! replays the recording, which must give the actual files.

use std::collections::HashMap;
use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::os::unix::ffi::OsStrExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

/// A file, independent of its name.
pub type FileId = u32;

/// An operation, in the order of effect.
#[derive(Clone, Debug)]
pub enum Op {
    MakeFolder {
        name: PathBuf,
    },
    Create {
        name: PathBuf,
        file: FileId,
    },
    Rename {
        from: PathBuf,
        to: PathBuf,
        file: FileId,
    },
    Unlink {
        name: PathBuf,
    },
    Write {
        file: FileId,
        offset: u64,
        bytes: Vec<u8>,
    },
    SetLength {
        file: FileId,
        length: u64,
    },
    /// The begin of a sync. It covers only earlier operations.
    SyncBegins {
        file: FileId,
        sync: u32,
    },
    SyncFolderBegins {
        folder: PathBuf,
        sync: u32,
    },
    /// A sync that has returned successfully.
    SyncEnds {
        sync: u32,
    },
    /// This was acknowledged as durable.
    Acknowledged(String),
}

/// Paths of the files at the start, and the operations since.
pub struct Recording {
    pub begin: Vec<(PathBuf, FileId)>,
    pub ops: Vec<Op>,
}

struct Recorder {
    root: PathBuf,
    names: HashMap<PathBuf, FileId>,
    begin: Vec<(PathBuf, FileId)>,
    next: u32,
    ops: Vec<Op>,
}

static IS_ON: AtomicBool = AtomicBool::new(false);
static RECORDER: Mutex<Option<Recorder>> = Mutex::new(None);

/// Starts to record all operations under `root`.
pub fn start(root: &Path) {
    let root = root.canonicalize().unwrap();
    let mut names = HashMap::new();
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    let name = path.strip_prefix(&root).unwrap().to_owned();
                    names.insert(name, names.len() as FileId);
                }
            }
        }
    }
    let begin = names.iter().map(|(name, file)| (name.clone(), *file)).collect();
    let next = names.len() as u32;
    *lock() = Some(Recorder { root, names, begin, next, ops: Vec::new() });
    IS_ON.store(true, Ordering::SeqCst);
}

/// Ends the recording, and returns it.
pub fn stop() -> Recording {
    IS_ON.store(false, Ordering::SeqCst);
    let Recorder { begin, ops, .. } = lock().take().expect("a recording");
    Recording { begin, ops }
}

/// Records the acknowledgement of a change.
pub fn acknowledge(line: String) {
    if let Some(recorder) = &mut *lock() {
        recorder.ops.push(Op::Acknowledged(line));
    }
}

fn lock() -> MutexGuard<'static, Option<Recorder>> {
    RECORDER.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Recorder {
    fn name_of(&self, path: &Path) -> Option<PathBuf> {
        path.strip_prefix(&self.root).ok().map(Path::to_owned)
    }

    fn name_of_fd(&self, fd: c_int) -> Option<PathBuf> {
        self.name_of(&std::fs::read_link(format!("/proc/self/fd/{fd}")).ok()?)
    }

    fn file_of_fd(&self, fd: c_int) -> Option<FileId> {
        self.names.get(&self.name_of_fd(fd)?).copied()
    }

    fn new_id(&mut self) -> u32 {
        self.next += 1;
        self.next
    }
}

/// libc's own function of a name that this binary overrides.
macro_rules! libcs {
    ($name:literal as $signature:ty) => {{
        static FOUND: OnceLock<usize> = OnceLock::new();
        let found = *FOUND.get_or_init(|| {
            let name = concat!($name, "\0");
            // SAFETY: the name ends with a zero; -1 is RTLD_NEXT: the next one after this binary's own.
            unsafe { dlsym(std::ptr::without_provenance_mut(usize::MAX), name.as_ptr().cast()) as usize }
        });
        assert!(found != 0, "libc has no {}", $name);
        // SAFETY: libc's function of this name has this signature.
        unsafe { std::mem::transmute::<usize, $signature>(found) }
    }};
}

unsafe extern "C" {
    fn dlsym(handle: *mut c_void, name: *const c_char) -> *mut c_void;
    fn lseek64(fd: c_int, offset: i64, whence: c_int) -> i64;
}

/// The path that a caller of libc gives, made absolute.
///
/// # Safety
/// `path` is a string of C.
unsafe fn path_of(path: *const c_char) -> PathBuf {
    // SAFETY: the caller promises it.
    let path = unsafe { CStr::from_ptr(path) };
    let path = Path::new(std::ffi::OsStr::from_bytes(path.to_bytes()));
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

/// The recorder, while recording.
fn recorder() -> Option<MutexGuard<'static, Option<Recorder>>> {
    IS_ON.load(Ordering::SeqCst).then(lock).filter(|recorder| recorder.is_some())
}

fn note_write(recorder: &mut Recorder, file: FileId, offset: u64, buffer: *const c_void, written: isize) {
    if let Ok(length) = usize::try_from(written) {
        // SAFETY: the kernel has just read this many bytes of the buffer.
        let bytes = unsafe { std::slice::from_raw_parts(buffer.cast::<u8>(), length) }.to_vec();
        recorder.ops.push(Op::Write { file, offset, bytes });
    }
}

/// # Safety
/// As pwrite(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn pwrite64(fd: c_int, buffer: *const c_void, count: usize, offset: i64) -> isize {
    let libcs = libcs!("pwrite64" as unsafe extern "C" fn(c_int, *const c_void, usize, i64) -> isize);
    let mut held = recorder();
    // SAFETY: the caller's promises are those of libc.
    let written = unsafe { libcs(fd, buffer, count, offset) };
    if let Some(recorder) = held.as_deref_mut().and_then(Option::as_mut)
        && let Some(file) = recorder.file_of_fd(fd)
    {
        note_write(recorder, file, offset.cast_unsigned(), buffer, written);
    }
    written
}

/// # Safety
/// As write(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn write(fd: c_int, buffer: *const c_void, count: usize) -> isize {
    let libcs = libcs!("write" as unsafe extern "C" fn(c_int, *const c_void, usize) -> isize);
    let mut held = recorder();
    let file = held.as_deref().and_then(Option::as_ref).and_then(|recorder| recorder.file_of_fd(fd));
    // SAFETY: queries the file offset (SEEK_CUR), and does not move it.
    let offset = file.map(|_| unsafe { lseek64(fd, 0, 1) }.cast_unsigned());
    // SAFETY: the caller's promises are those of libc.
    let written = unsafe { libcs(fd, buffer, count) };
    if let (Some(recorder), Some(file), Some(offset)) =
        (held.as_deref_mut().and_then(Option::as_mut), file, offset)
    {
        note_write(recorder, file, offset, buffer, written);
    }
    written
}

/// # Safety
/// As ftruncate(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn ftruncate64(fd: c_int, length: i64) -> c_int {
    let libcs = libcs!("ftruncate64" as unsafe extern "C" fn(c_int, i64) -> c_int);
    let mut held = recorder();
    // SAFETY: the caller's promises are those of libc.
    let result = unsafe { libcs(fd, length) };
    if let Some(recorder) = held.as_deref_mut().and_then(Option::as_mut)
        && result == 0
        && let Some(file) = recorder.file_of_fd(fd)
    {
        recorder.ops.push(Op::SetLength { file, length: length.cast_unsigned() });
    }
    result
}

/// Records begin and end of a sync; the lock is not held meanwhile, so that writes can continue.
fn synced(fd: c_int, call: impl FnOnce() -> c_int) -> c_int {
    let mut begun = None;
    if let Some(recorder) = recorder().as_deref_mut().and_then(Option::as_mut)
        && let Some(name) = recorder.name_of_fd(fd)
    {
        let sync = recorder.new_id();
        match recorder.names.get(&name) {
            Some(&file) => recorder.ops.push(Op::SyncBegins { file, sync }),
            None => recorder.ops.push(Op::SyncFolderBegins { folder: name, sync }),
        }
        begun = Some(sync);
    }
    let result = call();
    if let Some(recorder) = recorder().as_deref_mut().and_then(Option::as_mut)
        && let Some(sync) = begun.filter(|_| result == 0)
    {
        recorder.ops.push(Op::SyncEnds { sync });
    }
    result
}

/// # Safety
/// As fsync(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fsync(fd: c_int) -> c_int {
    let libcs = libcs!("fsync" as unsafe extern "C" fn(c_int) -> c_int);
    // SAFETY: the caller's promises are those of libc.
    synced(fd, || unsafe { libcs(fd) })
}

/// # Safety
/// As fdatasync(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fdatasync(fd: c_int) -> c_int {
    let libcs = libcs!("fdatasync" as unsafe extern "C" fn(c_int) -> c_int);
    // SAFETY: the caller's promises are those of libc.
    synced(fd, || unsafe { libcs(fd) })
}

/// Takes the mode as a fixed argument; callers without one leave it undefined, and then it is ignored.
///
/// # Safety
/// As open(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn open64(path: *const c_char, flags: c_int, mode: c_uint) -> c_int {
    const CREATES: c_int = 0o100;
    const TRUNCATES: c_int = 0o1000;
    let libcs = libcs!("open64" as unsafe extern "C" fn(*const c_char, c_int, ...) -> c_int);
    let mut held = recorder();
    // SAFETY: the caller's promises are those of libc.
    let name = held.as_deref().and_then(Option::as_ref).and_then(|it| it.name_of(&unsafe { path_of(path) }));
    // SAFETY: as above.
    let fd = unsafe { libcs(path, flags, mode) };
    if let (Some(recorder), Some(name)) = (held.as_deref_mut().and_then(Option::as_mut), name)
        && fd >= 0
        && flags & (CREATES | TRUNCATES) != 0
    {
        match recorder.names.get(&name) {
            Some(&file) if flags & TRUNCATES != 0 => recorder.ops.push(Op::SetLength { file, length: 0 }),
            Some(_) => {}
            None => {
                let file = recorder.new_id();
                recorder.names.insert(name.clone(), file);
                recorder.ops.push(Op::Create { name, file });
            }
        }
    }
    fd
}

/// # Safety
/// As mkdir(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn mkdir(path: *const c_char, mode: c_uint) -> c_int {
    let libcs = libcs!("mkdir" as unsafe extern "C" fn(*const c_char, c_uint) -> c_int);
    let mut held = recorder();
    // SAFETY: the caller's promises are those of libc.
    let result = unsafe { libcs(path, mode) };
    if let Some(recorder) = held.as_deref_mut().and_then(Option::as_mut)
        && result == 0
        // SAFETY: as above.
        && let Some(name) = recorder.name_of(&unsafe { path_of(path) })
    {
        recorder.ops.push(Op::MakeFolder { name });
    }
    result
}

/// # Safety
/// As rename(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn rename(from: *const c_char, to: *const c_char) -> c_int {
    let libcs = libcs!("rename" as unsafe extern "C" fn(*const c_char, *const c_char) -> c_int);
    let mut held = recorder();
    // SAFETY: the caller's promises are those of libc.
    let result = unsafe { libcs(from, to) };
    if let Some(recorder) = held.as_deref_mut().and_then(Option::as_mut)
        && result == 0
        // SAFETY: as above.
        && let (Some(from), Some(to)) = unsafe { (recorder.name_of(&path_of(from)), recorder.name_of(&path_of(to))) }
        && let Some(file) = recorder.names.remove(&from)
    {
        recorder.names.insert(to.clone(), file);
        recorder.ops.push(Op::Rename { from, to, file });
    }
    result
}

/// # Safety
/// As unlink(2).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn unlink(path: *const c_char) -> c_int {
    let libcs = libcs!("unlink" as unsafe extern "C" fn(*const c_char) -> c_int);
    let mut held = recorder();
    // SAFETY: the caller's promises are those of libc.
    let result = unsafe { libcs(path) };
    if let Some(recorder) = held.as_deref_mut().and_then(Option::as_mut)
        && result == 0
        // SAFETY: as above.
        && let Some(name) = recorder.name_of(&unsafe { path_of(path) })
    {
        recorder.names.remove(&name);
        recorder.ops.push(Op::Unlink { name });
    }
    result
}
