//! A slow network: a loopback relay that limits and counts the bytes per second.
//!
//! Transfers that take a millisecond on loopback become slow enough to kill a process in the middle.

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

/// Bytes forwarded at a time.
const PIECE: usize = 4096;

#[derive(Default)]
struct Gauge {
    /// Limit of each connection and direction, bytes per second; 0: no limit.
    bytes_per_second: AtomicU64,
    /// From clients to the server.
    sent: AtomicU64,
    closed: AtomicBool,
}

/// The relay; it closes when dropped.
pub struct SlowLink {
    port: u16,
    gauge: Arc<Gauge>,
}

impl SlowLink {
    /// A relay to a port, without limit at first.
    pub fn to(target: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = listener.local_addr().expect("an address").port();
        let gauge = Arc::<Gauge>::default();
        let of_all = Arc::clone(&gauge);
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                if of_all.closed.load(Ordering::Relaxed) {
                    return;
                }
                // If the coordinator refuses connections, so does the relay.
                let Ok(server) = TcpStream::connect(("127.0.0.1", target)) else { continue };
                for stream in [&client, &server] {
                    stream.set_nodelay(true).expect("a socket option");
                }
                let (client_back, server_back) =
                    (client.try_clone().expect("a socket"), server.try_clone().expect("a socket"));
                let gauge = Arc::clone(&of_all);
                std::thread::spawn(move || pass_on(client, server, &gauge, true));
                let gauge = Arc::clone(&of_all);
                std::thread::spawn(move || pass_on(server_back, client_back, &gauge, false));
            }
        });
        Self { port, gauge }
    }

    pub fn url(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    /// Bytes per second; 0: no limit.
    pub fn limit(&self, bytes_per_second: u64) {
        self.gauge.bytes_per_second.store(bytes_per_second, Ordering::Relaxed);
    }

    /// Bytes sent to the server.
    pub fn sent(&self) -> u64 {
        self.gauge.sent.load(Ordering::Relaxed)
    }
}

impl Drop for SlowLink {
    fn drop(&mut self) {
        self.gauge.closed.store(true, Ordering::Relaxed);
        // Wakes the thread that accepts.
        let _ = TcpStream::connect(("127.0.0.1", self.port));
    }
}

/// Forwards until one end closes, then closes the other.
fn pass_on(mut from: TcpStream, mut to: TcpStream, gauge: &Gauge, to_server: bool) {
    let mut piece = [0; PIECE];
    while let Ok(count @ 1..) = from.read(&mut piece) {
        let rate = gauge.bytes_per_second.load(Ordering::Relaxed);
        if rate > 0 {
            std::thread::sleep(Duration::from_secs_f64(count as f64 / rate as f64));
        }
        // Bytes in flight are lost when the link is cut.
        if gauge.closed.load(Ordering::Relaxed) || to.write_all(&piece[..count]).is_err() {
            break;
        }
        if to_server {
            gauge.sent.fetch_add(count as u64, Ordering::Relaxed);
        }
    }
    for stream in [from, to] {
        // It may already be closed.
        let _ = stream.shutdown(Shutdown::Both);
    }
}
