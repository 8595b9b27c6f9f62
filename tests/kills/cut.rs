//! A network that can be cut: a relay between a coordinator and its database, over Unix sockets.

use std::io::{Read as _, Write as _};
use std::net::Shutdown;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Name of PostgreSQL's socket in its folder.
const SOCKET: &str = ".s.PGSQL.5432";

/// The relay. While it is cut, bytes stay where they are and no connection closes, as behind a broken switch.
pub struct Cut {
    folder: tempfile::TempDir,
    is_cut: Arc<AtomicBool>,
}

impl Cut {
    /// A relay to the server whose socket is in `folder`.
    pub fn to(folder: &Path) -> Self {
        let own = tempfile::Builder::new().prefix("fathom-cut-").tempdir().expect("a folder");
        let listener = UnixListener::bind(own.path().join(SOCKET)).expect("a socket");
        let (target, is_cut) = (folder.join(SOCKET), Arc::<AtomicBool>::default());
        let of_all = Arc::clone(&is_cut);
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let Ok(server) = UnixStream::connect(&target) else { continue };
                for (from, to) in [(&client, &server), (&server, &client)] {
                    let (from, to) = (from.try_clone().expect("a socket"), to.try_clone().expect("a socket"));
                    let is_cut = Arc::clone(&of_all);
                    std::thread::spawn(move || pass_on(from, to, &is_cut));
                }
            }
        });
        Self { folder: own, is_cut }
    }

    /// The URL of a database behind it.
    pub fn url(&self, database: &str) -> String {
        let path = database.split_once('?').map_or(database, |(path, _)| path);
        format!("{path}?host={}", self.folder.path().display())
    }

    /// Cuts the network, or mends it.
    pub fn set(&self, is_cut: bool) {
        self.is_cut.store(is_cut, Ordering::Relaxed);
    }
}

fn pass_on(mut from: UnixStream, mut to: UnixStream, is_cut: &AtomicBool) {
    let mut piece = [0; 16 << 10];
    while let Ok(bytes @ 1..) = from.read(&mut piece) {
        while is_cut.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(10));
        }
        if to.write_all(&piece[..bytes]).is_err() {
            break;
        }
    }
    for socket in [from, to] {
        let _ = socket.shutdown(Shutdown::Both);
    }
}
