//! Where the jobs and files of a scenario are: in a data directory, or in PostgreSQL and a bucket.

use std::path::{Path, PathBuf};

use super::{Harness, PREFIX, Rules};
use crate::cut::Cut;
use crate::files::copy;
use crate::postgres::{Disk, Server};
use crate::s3::S3Server;

/// Leases on a database last at least this long, milliseconds: longer than a pool takes to connect again.
const LEASE_ON_DATABASE_MS: u64 = 3000;

/// Whether `FATHOM_KILLS_STORE=postgres` puts jobs into a database and files into a bucket, in the scenarios
/// that need neither.
fn is_on_database() -> bool {
    match std::env::var("FATHOM_KILLS_STORE").as_deref() {
        Ok("postgres") => true,
        Ok(other) => panic!("FATHOM_KILLS_STORE is {other:?}; it takes postgres, or is not set"),
        Err(_) => false,
    }
}

/// Whether jobs and files of such a scenario are in a data directory; says that it skips the scenario if not.
pub fn has_data_directory(scenario: &str) -> bool {
    if is_on_database() {
        eprintln!("{scenario}: skipped, since it is about the disk of a data directory");
    }
    !is_on_database()
}

impl Harness {
    /// A coordinator without workers, with its jobs in a database of its own and its files in a bucket;
    /// `None` where PostgreSQL is missing.
    pub fn on_database(scenario: &'static str) -> Option<Self> {
        Self::on_database_of(scenario, None)
    }

    /// The same with another version of the program.
    pub fn on_database_of(scenario: &'static str, program: Option<PathBuf>) -> Option<Self> {
        let server = Server::start(Disk::Synced)?;
        let url = server.database();
        Some(Self::on(scenario, server, url, S3Server::start(), program))
    }

    /// As [`Harness::on_database`], with a network to the database that can be cut.
    pub fn behind_a_network(scenario: &'static str) -> Option<(Self, Cut)> {
        let server = Server::start(Disk::Synced)?;
        let network = Cut::to(server.folder());
        let url = network.url(&server.database());
        Some((Self::on(scenario, server, url, S3Server::start(), None), network))
    }

    fn on(
        scenario: &'static str,
        server: Server,
        url: String,
        bucket: S3Server,
        program: Option<PathBuf>,
    ) -> Self {
        let mut harness = Self::of(scenario, Rules::default());
        harness.give_engines(server, url, bucket);
        harness.is_direct = true;
        harness.program = program;
        harness.start_coordinator();
        harness
    }

    /// A service of what another one had, on this machine: a dump of its database, and a copy of its bucket.
    pub fn restored(scenario: &'static str, dump: &Path, bucket: &Path) -> Option<Self> {
        let server = Server::start(Disk::Synced)?;
        let url = server.restored(dump);
        let files = S3Server::start();
        copy(bucket, &files.folder(PREFIX));
        Some(Self::on(scenario, server, url, files, None))
    }

    /// Copies all files of its bucket.
    pub fn copy_bucket(&self, to: &Path) {
        copy(&self.bucket().folder(PREFIX), to);
    }

    /// Starts no process yet.
    pub fn stopped(scenario: &'static str, rules: Rules) -> Self {
        let mut harness = Self::of(scenario, rules);
        if is_on_database() {
            let server = Server::start(Disk::Synced).expect("PostgreSQL, for FATHOM_KILLS_STORE=postgres");
            let url = server.database();
            harness.give_engines(server, url, S3Server::start());
        }
        harness
    }

    fn give_engines(&mut self, server: Server, url: String, bucket: S3Server) {
        self.database = Some((server, url));
        self.bucket = Some(bucket);
        self.rules.lease_ms = self.rules.lease_ms.max(LEASE_ON_DATABASE_MS);
    }
}
