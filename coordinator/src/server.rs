//! A coordinator as one value: started with [`serve`], stopped with [`Coordinator::stop`].

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::sync::atomic::AtomicU32;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use fathom_observe::http;
use fathom_proto::admin::v1::admin_service_server::AdminServiceServer;
use fathom_proto::v1::job_service_server::JobServiceServer;
use fathom_proto::v1::upload_service_server::UploadServiceServer;
use fathom_proto::worker::v1::worker_service_server::WorkerServiceServer;
use futures::{Stream, StreamExt};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic::transport::server::Connected;
use tower_layer::Layer;

use crate::access::calls::OpenCalls;
use crate::access::guard::{Guard, GuardLayer};
use crate::access::places::Places;
use crate::access::{Access, RateLimit, Token, ensure_operator};
use crate::clock::Clock;
use crate::company::keep_in_touch;
use crate::config::CoordinatorConfig;
use crate::connections::{Accepted, Connections, Room, accepted};
use crate::data_dir;
use crate::error::CoordinatorError;
use crate::history;
use crate::metrics::Metrics;
use crate::metrics::endpoint::Endpoint;
use crate::metrics::rpc::RpcLayer;
use crate::metrics::store::CountedStore;
use crate::objects::{ObjectsAt, Removed, TenantBlobs};
use crate::own_tasks::run_own_tasks;
use crate::rate_limited_log::RateLimitedLog;
use crate::retention::{Housekeeping, Policy, RetentionError, collect, collect_garbage};
use crate::scaler;
use crate::services::{Admin, Jobs, Uploads, Workers, logs, release_disowned};
use crate::state::{State, stopped};
use crate::store::{Hold, PostgresOptions, PostgresStore, SledOptions, SledStore, Store};
use crate::sweep::sweep_leases;
use crate::tls::Tls;
use crate::wakeups::Wakeups;
use crate::web;
use crate::webhook::Webhook;
use crate::worker_registry::WorkerRegistry;

/// A half-open connection is detected after the sum of these; without keep-alives its streams would hang for
/// hours.
pub const KEEPALIVE_EVERY: Duration = Duration::from_secs(20);
pub const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);
/// Largest accepted message, with margin.
const MAX_MESSAGE_BYTES: usize = 4 << 20;
/// The same of uploads: ten thousand files with the longest paths that may be, or a piece of a blob.
pub const MAX_UPLOAD_MESSAGE_BYTES: usize = 12 << 20;
/// Maximum open calls of a connection; one more waits at the client.
pub const MAX_CALLS_OF_A_CONNECTION: u32 = 1024;
/// Time that open calls have to end when the coordinator stops.
const STOP_WITHIN: Duration = Duration::from_secs(5);
/// Time that calls have to notice that their connections are closed.
const CLOSE_WITHIN: Duration = Duration::from_secs(1);

/// A running coordinator.
pub struct Coordinator {
    address: SocketAddr,
    scheme: &'static str,
    metrics_address: Option<SocketAddr>,
    web_address: Option<SocketAddr>,
    invitations: Option<watch::Receiver<Option<Token>>>,
    scaler_address: Option<SocketAddr>,
    stopping: watch::Sender<bool>,
    running: JoinHandle<Result<(), CoordinatorError>>,
    connections: Arc<Connections>,
    shared: Arc<State>,
}

impl Coordinator {
    /// The address it listens on, with the actual port if 0 was configured.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The URL for workers and clients.
    pub fn url(&self) -> String {
        format!("{}://{}", self.scheme, self.address)
    }

    /// The address of metrics and health, if served.
    pub fn metrics_address(&self) -> Option<SocketAddr> {
        self.metrics_address
    }

    /// The address of the HTTP interface, if served.
    pub fn web_address(&self) -> Option<SocketAddr> {
        self.web_address
    }

    /// The invitations to the page of this process ([`CoordinatorConfig::own_page`]): each can be used once.
    pub fn invitations(&self) -> Option<watch::Receiver<Option<Token>>> {
        self.invitations.clone()
    }

    /// The address of the scaler, if served.
    pub fn scaler_address(&self) -> Option<SocketAddr> {
        self.scaler_address
    }

    /// Collects garbage now by a policy, and returns what was removed. This also runs once an hour by the
    /// configured policy.
    ///
    /// # Errors
    /// When the store or the disk fails, or a referenced blob cannot be read.
    pub async fn collect(&self, policy: Policy) -> Result<Removed, RetentionError> {
        collect(&self.shared, policy).await
    }

    /// Waits until it ends by itself.
    ///
    /// # Errors
    /// When the store or the server failed.
    pub async fn wait(self) -> Result<(), CoordinatorError> {
        let Self { stopping, running, shared, .. } = self;
        drop(shared);
        let result = flatten(running.await);
        drop(stopping);
        result
    }

    /// Stops it gracefully: open calls are answered, leases stay for the next process.
    ///
    /// # Errors
    /// When it had failed before.
    pub async fn stop(self) -> Result<(), CoordinatorError> {
        self.stopping.send_replace(true);
        let Self { mut running, connections, shared, .. } = self;
        // The store closes when the server drops its own reference, too.
        drop(shared);
        if let Ok(result) = tokio::time::timeout(STOP_WITHIN, &mut running).await {
            return flatten(result);
        }
        // Their calls hold the store, however slowly their clients read or write.
        connections.close(true);
        match tokio::time::timeout(CLOSE_WITHIN, &mut running).await {
            Ok(result) => flatten(result),
            Err(_) => {
                running.abort();
                // Waits until everything that it held is dropped, in particular the lock on the store.
                let _ = running.await;
                Ok(())
            }
        }
    }
}

fn flatten(
    result: Result<Result<(), CoordinatorError>, tokio::task::JoinError>,
) -> Result<(), CoordinatorError> {
    result.unwrap_or_else(|error| Err(CoordinatorError::Server(error.to_string())))
}

/// Starts a coordinator. It serves when this returns.
///
/// # Errors
/// When the configuration contradicts itself, the address is taken, or the data directory cannot be opened.
pub async fn serve(config: CoordinatorConfig) -> Result<Coordinator, CoordinatorError> {
    let tls = tls_of(&config)?;
    // First, because a coordinator that cannot listen must leave nothing behind.
    let (listener, address) = listen(config.listen).await?;
    let config = CoordinatorConfig { listen: address, ..config };
    let for_metrics = match config.metrics_listen {
        Some(address) => Some(listen(address).await?),
        None => None,
    };
    let for_web = match config.web {
        Some(address) => Some((listen(address).await?, tls.as_ref().map(|tls| tls.for_web()).transpose()?)),
        None => None,
    };
    let for_scaler = match config.scaler_listen {
        Some(address) => Some((listen(address).await?, Tls::of_scaler(&config)?)),
        None => None,
    };
    let clock = Clock::start();
    data_dir::make(&config.data_dir)?;
    let at = ObjectsAt::parse(config.objects.as_deref(), &config.data_dir)?.signed_by(|signing| {
        let signing = if tls.is_some() { signing.with_tls() } else { signing };
        config.direct_transfers.then(|| signing.writing_from(config.direct_uploads_from_bytes))
    });
    let store = open_store(&config, &at).await?;
    at.hold_for(&store.deployment().await?, &config.data_dir).await?;
    let objects =
        TenantBlobs::open(at, &config.data_dir, config.min_free_bytes, clock, store.ledger()).await?;
    let house = config.housekeeping();
    let room = Room::of_this_process();
    let incoming = accepted(listener);
    let mut coordinator =
        start(config, tls, objects, store, clock, house, for_metrics, for_web, room, incoming).await?;
    if let Some(((listener, address), tls)) = for_scaler {
        tracing::info!(%address, with_certificates = tls.is_some(), "serving KEDA");
        coordinator.scaler_address = Some(address);
        tokio::spawn(scaler::serve(Arc::clone(&coordinator.shared), listener, tls));
    }
    Ok(coordinator)
}

/// The store that the configuration names. A database serves several coordinators when their files are in a
/// bucket too; otherwise it is held for this process alone.
async fn open_store(
    config: &CoordinatorConfig,
    objects: &ObjectsAt,
) -> Result<Arc<dyn Store>, CoordinatorError> {
    let (rules, lease_ms, stall_ms) = (config.rules(), config.lease_ms.into(), config.stall_ms.into());
    if let Some(url) = &config.store {
        let connections = config.store_connections;
        let options = PostgresOptions { url: url.clone(), rules, lease_ms, stall_ms, connections };
        let held = data_dir::hold_for_database(&config.data_dir, &options.place()?)?;
        let store = PostgresStore::open(&options).await?;
        let hold = match objects {
            ObjectsAt::Bucket { .. } => Hold::WithOthers,
            ObjectsAt::Folder(_) => Hold::Alone,
        };
        store.hold(hold, Some(held)).await?;
        return Ok(Arc::new(store));
    }
    data_dir::refuse_if_of_database(&config.data_dir)?;
    let options = SledOptions { dir: config.data_dir.join("store"), rules, lease_ms, stall_ms };
    let opened = tokio::task::spawn_blocking(move || SledStore::open(&options)).await;
    Ok(Arc::new(opened.map_err(|error| CoordinatorError::Server(error.to_string()))??))
}

/// Starts a coordinator on a given store, clock and connections, with given settings of garbage collection,
/// for simulations. Blobs lie in `data_dir`, logs too unless the store has them, metrics are not served, and
/// `listen` is only the reported address.
///
/// # Errors
/// As [`serve`].
pub async fn serve_over<S, I, C>(
    config: CoordinatorConfig,
    store: S,
    clock: Clock,
    house: Housekeeping,
    incoming: I,
) -> Result<Coordinator, CoordinatorError>
where
    S: Store + 'static,
    I: Stream<Item = io::Result<C>> + Send + 'static,
    C: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    let tls = tls_of(&config)?;
    let at = ObjectsAt::Folder(config.data_dir.clone());
    let objects = TenantBlobs::open(at, &config.data_dir, config.min_free_bytes, clock, None).await?;
    let incoming = incoming.filter_map(|accepted| std::future::ready(accepted.ok().map(|io| (io, None))));
    let room = Room::of_descriptors(None);
    start(config, tls, objects, Arc::new(store), clock, house, None, None, room, incoming).await
}

/// TLS where the configuration has it, once the configuration is found to be free of contradictions.
fn tls_of(config: &CoordinatorConfig) -> Result<Option<Arc<Tls>>, CoordinatorError> {
    let faults = config.faults();
    if !faults.is_empty() {
        return Err(CoordinatorError::Config(faults.join("; ")));
    }
    Tls::read(config)
}

async fn start<I, C>(
    config: CoordinatorConfig,
    tls: Option<Arc<Tls>>,
    objects: TenantBlobs,
    store: Arc<dyn Store>,
    clock: Clock,
    house: Housekeeping,
    for_metrics: Option<Bound>,
    for_web: Option<(Bound, Option<Arc<Tls>>)>,
    room: Room,
    incoming: I,
) -> Result<Coordinator, CoordinatorError>
where
    I: Stream<Item = Accepted<C>> + Send + 'static,
    C: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    let address = config.listen;
    let scheme = if tls.is_some() { "https" } else { "http" };
    let metrics_address = for_metrics.as_ref().map(|(_, address)| *address);
    let web_address = for_web.as_ref().map(|((_, address), _)| *address);
    store.recover(clock.now_ms()).await?;
    for (_, objects) in objects.all().await? {
        objects.discard_staged()?;
    }
    let marks = store.worker_marks().await?.into_iter().collect();
    let access = if config.tokens {
        if let Some(path) = ensure_operator(store.as_ref(), &config.data_dir, clock.now_ms()).await? {
            tracing::info!(path = %path.display(), "wrote a token for the first operator");
        }
        Arc::new(Access::by_tokens(store.tokens().await?))
    } else {
        Arc::new(Access::open())
    };
    let members = Arc::new(AtomicU32::new(1));
    let guarded_by = |access: &Arc<Access>| Guard {
        access: Arc::clone(access),
        rate: RateLimit::new(config.calls_per_second, Arc::clone(&members)),
        workers_show_certificates: config.client_ca.is_some(),
        clock,
        places: Places::default(),
        calls: Arc::new(OpenCalls::default()),
        refused: RateLimitedLog::default(),
    };
    let guard = guarded_by(&access);
    let connections = Connections::new(room);

    let (stopping, stop_signal) = watch::channel(false);
    let own_page = (config.own_page && !config.tokens).then(|| Arc::new(Access::by_invitation()));
    let invitations = own_page.as_ref().map(|access| access.invitations());
    let page_guard = own_page.map(|access| GuardLayer(Arc::new(guarded_by(&access))));
    if let Some(GuardLayer(guard)) = &page_guard {
        let (calls, access, mut ends) =
            (Arc::clone(&guard.calls), Arc::clone(&guard.access), stop_signal.clone());
        tokio::spawn(async move {
            tokio::select! {
                () = stopped(&mut ends) => {}
                () = calls.watch(access, clock) => {}
            }
        });
    }
    let webhook = Webhook::of(&config)?;
    let metrics = Arc::new(Metrics::default());
    let shared = Arc::new(State {
        logs: crate::logs::of(store.as_ref(), &config.data_dir, config.attempt_log_bytes),
        jobs: Arc::new(CountedStore { store: Arc::clone(&store), metrics: Arc::clone(&metrics) }),
        store,
        objects,
        access,
        own_lines: Arc::default(),
        history: Default::default(),
        links: Default::default(),
        metrics,
        clock,
        lease_ms: config.lease_ms,
        wakeups: Wakeups::default(),
        stopping: stop_signal,
        members,
        workers: WorkerRegistry::new(clock, config.lease_ms, marks),
        gaps: Mutex::new(HashMap::new()),
        revoking: Default::default(),
        backing_up: Default::default(),
        has_webhook: webhook.is_some(),
        capacity_timeout_ms: config.capacity_timeout_ms,
        policy: house.policy,
    });
    tracing::info!(%address, data_dir = %config.data_dir.display(), lease_ms = config.lease_ms, "coordinator serves");
    let lines = (Arc::clone(&shared.own_lines), Arc::clone(&shared.logs));
    tokio::spawn(logs::keep_own_lines(lines.0, lines.1, shared.stopping.clone()));
    if let Some(webhook) = webhook {
        tokio::spawn(webhook.run(Arc::clone(&shared)));
    }
    if let Some((listener, address)) = for_metrics {
        tracing::info!(%address, "serving metrics and health");
        let served = http::serve(listener, Arc::new(Endpoint(Arc::downgrade(&shared))));
        let mut stopping = shared.stopping.clone();
        tokio::spawn(async move {
            tokio::select! {
                never = served => match never {},
                () = stopped(&mut stopping) => {}
            }
        });
    }
    let watched = (Arc::clone(&connections), Arc::clone(&guard.calls), Arc::clone(&shared.access));
    let mut ends = shared.stopping.clone();
    tokio::spawn(async move {
        let (connections, calls, access) = watched;
        tokio::select! {
            () = stopped(&mut ends) => {}
            () = connections.watch() => {}
            () = calls.watch(access, clock) => {}
        }
    });
    if let Some(members) = shared.store.members() {
        tokio::spawn(keep_in_touch(Arc::clone(&shared), members, Arc::clone(&connections)));
    }
    let guard = GuardLayer(Arc::new(guard));
    let web = for_web.map(|((listener, address), tls)| {
        tracing::info!(%address, with_tls = tls.is_some(), "serving the HTTP interface");
        let shared = Arc::clone(&shared);
        let is_own_page = page_guard.is_some();
        let guard = page_guard.unwrap_or_else(|| guard.clone());
        serve_web(shared, guard, is_own_page, tls, Arc::clone(&connections).of(accepted(listener)))
    });
    let incoming = Arc::clone(&connections).of(incoming);
    let running = match tls {
        None => tokio::spawn(run(Arc::clone(&shared), house.every, incoming, guard, web)),
        Some(tls) => {
            keep_fresh(&tls, &shared);
            tokio::spawn(run(Arc::clone(&shared), house.every, tls.over(incoming), guard, web))
        }
    };
    let scaler_address = None;
    Ok(Coordinator {
        address,
        metrics_address,
        web_address,
        invitations,
        scaler_address,
        scheme,
        stopping,
        running,
        connections,
        shared,
    })
}

/// Checks the files of TLS until the coordinator stops.
fn keep_fresh(tls: &Arc<Tls>, shared: &State) {
    let (watched, mut ends) = (Arc::clone(tls), shared.stopping.clone());
    tokio::spawn(async move {
        tokio::select! {
            () = stopped(&mut ends) => {}
            () = watched.watch() => {}
        }
    });
}

/// Serves the HTTP interface until the coordinator stops.
async fn serve_web<I, C>(
    shared: Arc<State>,
    guard: GuardLayer,
    is_own_page: bool,
    tls: Option<Arc<Tls>>,
    incoming: I,
) where
    I: Stream<Item = io::Result<C>> + Send + 'static,
    C: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    let door = RpcLayer(Arc::clone(&shared.metrics)).layer(guard.layer(user_services(&shared)));
    let mut stopping = shared.stopping.clone();
    let stops = async move { stopped(&mut stopping).await };
    let served = match tls {
        None => web::serve(incoming, door, guard.0, is_own_page, stops).await,
        Some(tls) => {
            keep_fresh(&tls, &shared);
            web::serve(tls.over(incoming), door, guard.0, is_own_page, stops).await
        }
    };
    if let Err(error) = served {
        tracing::error!(%error, "the HTTP interface ended; it is back when the coordinator starts again");
    }
}

/// A listener and its address, with the port that it got.
type Bound = (TcpListener, SocketAddr);

async fn listen(listen: SocketAddr) -> Result<Bound, CoordinatorError> {
    let failed = |source| CoordinatorError::Listen { listen, source };
    let listener = TcpListener::bind(listen).await.map_err(failed)?;
    let address = listener.local_addr().map_err(failed)?;
    Ok((listener, address))
}

async fn run<I, C>(
    shared: Arc<State>,
    look_every: Duration,
    incoming: I,
    guard: GuardLayer,
    web: Option<impl Future<Output = ()>>,
) -> Result<(), CoordinatorError>
where
    I: Stream<Item = io::Result<C>> + Send,
    C: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<JobServiceServer<Jobs>>().await;
    health.set_serving::<UploadServiceServer<Uploads>>().await;
    health.set_serving::<WorkerServiceServer<Workers>>().await;
    health.set_serving::<AdminServiceServer<Admin>>().await;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(fathom_proto::FILE_DESCRIPTOR_SET)
    };
    let failed = |e: tonic_reflection::server::Error| CoordinatorError::Server(e.to_string());
    // Many programs still use the older version of reflection.
    let (older, newer) =
        (reflection().build_v1alpha().map_err(failed)?, reflection().build_v1().map_err(failed)?);
    let (mut stopping, stops) = (shared.stopping.clone(), shared.stopping.clone());
    let server = Server::builder()
        // Outermost, so that refused calls are counted too.
        .layer(RpcLayer(Arc::clone(&shared.metrics)))
        .layer(guard)
        .http2_keepalive_interval(Some(KEEPALIVE_EVERY))
        .http2_keepalive_timeout(Some(KEEPALIVE_TIMEOUT))
        .max_concurrent_streams(MAX_CALLS_OF_A_CONNECTION)
        .tcp_nodelay(true)
        .add_routes(user_services(&shared))
        .add_service(health_service)
        .add_service(older)
        .add_service(newer)
        .add_service(
            WorkerServiceServer::new(Workers(Arc::clone(&shared)))
                .max_decoding_message_size(MAX_MESSAGE_BYTES),
        )
        .serve_with_incoming_shutdown(incoming, async move { stopped(&mut stopping).await });
    let (with_tasks, with_history, at_the_end) =
        (Arc::clone(&shared), Arc::clone(&shared), Arc::clone(&shared));
    let own_tasks = async {
        tokio::join!(run_own_tasks(with_tasks), history::store(with_history));
    };
    let house = collect_garbage(Arc::clone(&shared), look_every);
    let disowned = release_disowned(Arc::clone(&shared));
    let sweeper = sweep_leases(shared);
    let mut web_runs = web.is_some();
    let web = async {
        if let Some(web) = web {
            web.await;
        }
    };
    // All of them end on stop: open calls are answered, own tasks are given back.
    tokio::pin!(server, web, sweeper, own_tasks, house, disowned);
    let mut own_tasks_run = true;
    let mut sweeper_runs = true;
    let mut house_is_kept = true;
    let mut disowned_are_looked_for = true;
    loop {
        tokio::select! {
            biased;
            served = &mut server => {
                let own_tasks = async {
                    if own_tasks_run {
                        // They give their tasks back.
                        let _ = tokio::time::timeout(STOP_WITHIN / 2, &mut own_tasks).await;
                    }
                };
                let web = async {
                    // Its open requests are answered; [`Coordinator::stop`] bounds the time.
                    if web_runs && *stops.borrow() {
                        (&mut web).await;
                    }
                };
                tokio::join!(own_tasks, web);
                // Results that arrived meanwhile have brought the last points of their tasks.
                let _ = tokio::time::timeout(STOP_WITHIN / 5, history::store_waiting(&at_the_end)).await;
                return served.map_err(|e| CoordinatorError::Server(e.to_string()));
            }
            swept = &mut sweeper, if sweeper_runs => {
                swept?;
                sweeper_runs = false;
            }
            () = &mut web, if web_runs => web_runs = false,
            () = &mut own_tasks, if own_tasks_run => own_tasks_run = false,
            () = &mut house, if house_is_kept => house_is_kept = false,
            () = &mut disowned, if disowned_are_looked_for => disowned_are_looked_for = false,
        }
    }
}

/// The services of users, for gRPC and for the HTTP interface.
fn user_services(shared: &Arc<State>) -> Routes {
    let jobs = JobServiceServer::new(Jobs(Arc::clone(shared)));
    let uploads = UploadServiceServer::new(Uploads(Arc::clone(shared)));
    let admin = AdminServiceServer::new(Admin(Arc::clone(shared)));
    Routes::new(jobs.max_decoding_message_size(MAX_MESSAGE_BYTES))
        .add_service(uploads.max_decoding_message_size(MAX_UPLOAD_MESSAGE_BYTES))
        .add_service(admin.max_decoding_message_size(MAX_MESSAGE_BYTES))
}
