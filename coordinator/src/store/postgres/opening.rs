//! Connections and migrations.

use std::fs::File;
use std::str::FromStr;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, OnceLock, Weak};
use std::time::{Duration, Instant};

use sqlx::migrate::{MigrateError, Migration, MigrationType, Migrator};
use sqlx::postgres::{PgConnectOptions, PgPoolOptions};
use sqlx::{Connection, PgConnection, PgPool, SqlSafeStr};
use uuid::Uuid;

use super::super::{PROGRAM, StoreError};
use super::claims::Hints;
use super::queue::WaitingChanges;
use super::{Inner, PostgresStore, Settings, unavailable};
use crate::schedule::Rules;

/// Longest wait for a connection. The pool pauses for up to a fifth of it between attempts.
const CONNECT_WITHIN: Duration = Duration::from_secs(3);
/// Pause between two looks at the connection that keeps other coordinators away.
const WATCH_EVERY: Duration = Duration::from_secs(5);
/// Time in which the database notices that a coordinator is gone; see [`SESSION`].
const TAKE_OVER_WITHIN: Duration = Duration::from_secs(30);
/// The lock that coordinators hold together, or one of them alone.
const OF_COORDINATORS: i64 = 0x6661_7468_6f6d;
/// The database itself ends what takes longer, so that a coordinator behind a cut network holds no lock.
/// The same for connections whose client has gone without a word.
const SESSION: [(&str, &str); 9] = [
    // Whatever the server's default is: what is acknowledged must be on its disk.
    ("synchronous_commit", "on"),
    // The same reason as for the columns of `tasks`: an index is never wrong by much.
    ("enable_seqscan", "off"),
    ("tcp_keepalives_idle", "10"),
    ("tcp_keepalives_interval", "5"),
    ("tcp_keepalives_count", "3"),
    ("lock_timeout", "10s"),
    ("statement_timeout", "15s"),
    ("idle_in_transaction_session_timeout", "15s"),
    ("client_min_messages", "warning"),
];

/// Options for opening a [`PostgresStore`].
#[derive(Clone, Debug)]
pub struct PostgresOptions {
    /// `postgres://user:password@host:port/database`, with the parameters of libpq; the password may be in
    /// `PGPASSWORD` or a password file instead.
    pub url: String,
    /// Budgets and back-off.
    pub rules: Rules,
    /// Lease duration, milliseconds.
    pub lease_ms: u64,
    /// Time without progress after which a worker's lease is revoked, milliseconds; 0 disables it.
    pub stall_ms: u64,
    /// Most connections to the database; an eighth of them, at least one, is for renewals.
    pub connections: u32,
}

/// How a coordinator holds its database.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hold {
    /// Together with others that hold it so.
    WithOthers,
    /// Alone.
    Alone,
}

impl PostgresOptions {
    /// Host, port and database, without secrets.
    ///
    /// # Errors
    /// When the URL is wrong.
    pub fn place(&self) -> Result<String, StoreError> {
        let connect = connect_options(&self.url)?;
        let host = match connect.get_socket() {
            Some(socket) => socket.display().to_string(),
            None => connect.get_host().to_owned(),
        };
        let database = connect.get_database().unwrap_or(connect.get_username());
        Ok(format!("{host}:{}/{database}", connect.get_port()))
    }
}

impl PostgresStore {
    /// Connects, and creates the tables or brings them to this version.
    ///
    /// # Errors
    /// When the URL is wrong, the database cannot be reached, or a newer program has changed its tables.
    pub async fn open(options: &PostgresOptions) -> Result<Self, StoreError> {
        Self::open_with(options, true).await
    }

    /// As [`Self::open`], with the times that callers give instead of the database's clock.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub async fn open_with_own_clock(options: &PostgresOptions) -> Result<Self, StoreError> {
        Self::open_with(options, false).await
    }

    async fn open_with(options: &PostgresOptions, by_database_clock: bool) -> Result<Self, StoreError> {
        let connect = connect_options(&options.url)?;
        let mut conn = PgConnection::connect_with(&connect).await.map_err(unavailable)?;
        migrate(&mut conn).await?;
        conn.close().await.map_err(unavailable)?;
        let for_renewals = (options.connections / 8).max(1);
        let pool = pool(connect.clone(), options.connections.saturating_sub(for_renewals).max(1));
        let renewals = pool_of_renewals(connect.clone(), for_renewals);
        let settings = Settings {
            rules: options.rules.clone(),
            lease_ms: options.lease_ms,
            stall_ms: options.stall_ms,
            by_database_clock,
        };
        Ok(Self(Arc::new(Inner {
            settings,
            pool,
            renewals,
            waiting: WaitingChanges::default(),
            hints: Hints::default(),
            version: AtomicU64::new(0),
            grants: AtomicU64::new(0),
            connect,
            member: Uuid::new_v4().to_string(),
            holds: OnceLock::new(),
            failure: OnceLock::new(),
        })))
    }

    /// Refuses when another coordinator uses the database in a way that excludes this one, and keeps such
    /// ones away until this store is dropped. `with` is held as long.
    ///
    /// # Errors
    /// When another one has it, or the database cannot be reached.
    pub async fn hold(&self, hold: Hold, with: Option<File>) -> Result<(), StoreError> {
        let mut waits_since = None;
        let held = loop {
            if let Some(held) = lock(&self.0.connect, hold).await? {
                break held;
            }
            // The database may not have noticed yet that a killed one is gone.
            let since = *waits_since.get_or_insert_with(|| {
                let seconds = TAKE_OVER_WITHIN.as_secs();
                tracing::warn!(seconds, "the database has another coordinator; waiting for it to leave");
                Instant::now()
            });
            if since.elapsed() > TAKE_OVER_WITHIN {
                return Err(StoreError::DatabaseInUse);
            }
            tokio::time::sleep(WATCH_EVERY / 10).await;
        };
        let watch = tokio::spawn(watch(Arc::downgrade(&self.0), hold, held, with));
        // Once only: a store is opened for one coordinator.
        let _ = self.0.holds.set(watch.abort_handle());
        Ok(())
    }

    /// Closes all connections.
    pub async fn close(self) {
        self.0.pool.close().await;
        self.0.renewals.close().await;
    }
}

fn connect_options(url: &str) -> Result<PgConnectOptions, StoreError> {
    // Its message may contain the password.
    let connect = PgConnectOptions::from_str(url).map_err(|_| StoreError::BadUrl)?;
    Ok(connect.application_name("fathom-coordinator").options(SESSION))
}

pub(super) fn pool(connect: PgConnectOptions, connections: u32) -> PgPool {
    let options = PgPoolOptions::new().max_connections(connections).acquire_timeout(CONNECT_WITHIN);
    options.connect_lazy_with(connect)
}

fn pool_of_renewals(connect: PgConnectOptions, connections: u32) -> PgPool {
    pool(connect.options([("synchronous_commit", "off")]), connections)
}

/// Creates the tables or brings them to this version; two coordinators that start together take turns.
async fn migrate(conn: &mut PgConnection) -> Result<(), StoreError> {
    let all = [
        (1, "tables", include_str!("migrations/0001.sql")),
        (2, "histories", include_str!("migrations/0002.sql")),
    ];
    let migrations = all.map(|(version, name, sql)| {
        Migration::new(version, name.into(), MigrationType::Simple, sql.into_sql_str(), false)
    });
    let migrations = Migrator::with_migrations(migrations.to_vec());
    migrations.run(conn).await.map_err(|error| match error {
        MigrateError::VersionMissing(found) => StoreError::OtherSchema { found, program: PROGRAM },
        MigrateError::VersionMismatch(version) => StoreError::Corrupt {
            tree: "_sqlx_migrations",
            message: format!("migration {version} is not the one of Fathom {PROGRAM}"),
        },
        other => StoreError::Unavailable(other.to_string()),
    })
}

/// A connection that holds the database; `None` if another coordinator excludes that.
async fn lock(connect: &PgConnectOptions, hold: Hold) -> Result<Option<PgConnection>, StoreError> {
    let mut conn = PgConnection::connect_with(connect).await.map_err(unavailable)?;
    let lock = match hold {
        Hold::WithOthers => sqlx::query_scalar("SELECT pg_try_advisory_lock_shared($1)"),
        Hold::Alone => sqlx::query_scalar("SELECT pg_try_advisory_lock($1)"),
    };
    let got: bool = lock.bind(OF_COORDINATORS).fetch_one(&mut conn).await.map_err(unavailable)?;
    Ok(got.then_some(conn))
}

/// Takes the lock again when its connection was lost; ends the store if another coordinator was faster.
async fn watch(store: Weak<Inner>, hold: Hold, mut held: PgConnection, _with: Option<File>) {
    let mut lost: Option<Instant> = None;
    loop {
        tokio::time::sleep(WATCH_EVERY).await;
        let Some(store) = store.upgrade() else { return };
        let lives = tokio::time::timeout(CONNECT_WITHIN, held.ping()).await;
        if matches!(lives, Ok(Ok(()))) {
            continue;
        }
        match tokio::time::timeout(CONNECT_WITHIN, lock(&store.connect, hold)).await {
            Ok(Ok(Some(again))) => (held, lost) = (again, None),
            Ok(Ok(None)) => {
                // It may still be the lost connection, of which the database does not know yet.
                if lost.get_or_insert_with(Instant::now).elapsed() > TAKE_OVER_WITHIN {
                    let _ = store.failure.set("another coordinator has taken its database".to_owned());
                    return;
                }
            }
            // The database is not available; calls report it.
            Ok(Err(_)) | Err(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::conformance::postgres_server::database;
    use super::*;

    #[tokio::test]
    async fn commits_wait_for_the_disk_whatever_the_url_says() {
        let Some(url) = database() else { return };
        let url = format!("{url}&options=-c%20synchronous_commit=off");
        let options =
            PostgresOptions { url, rules: Rules::default(), lease_ms: 1000, stall_ms: 0, connections: 2 };
        let store = PostgresStore::open(&options).await.unwrap();
        for (pool, expected) in [(&store.0.pool, "on"), (&store.0.renewals, "off")] {
            let set: String = sqlx::query_scalar("SHOW synchronous_commit").fetch_one(pool).await.unwrap();
            assert_eq!(set, expected);
        }
    }
}
