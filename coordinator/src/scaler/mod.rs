//! KEDA's external scaler: how many workers each pool needs, at an address of its own.
//!
//! KEDA polls it and starts Kubernetes jobs, each a worker that ends when it is idle. It ends none for lack
//! of work: a scaler that cannot be reached, or that counts too few, costs time and no work. KEDA has no
//! tokens, hence the address of its own with certificates of its own.
//!
//! Two questions come in each poll, so both are answered from one look at the store, at most a second old.

mod demand;

use std::collections::HashMap;
use std::io;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::{Duration, Instant};

use fathom_proto::keda::external_scaler_server::{ExternalScaler, ExternalScalerServer};
use fathom_proto::keda::{
    GetMetricSpecResponse, GetMetricsRequest, GetMetricsResponse, IsActiveResponse, MetricSpec, MetricValue,
    ScaledObjectRef,
};
use futures::Stream;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::sync::{Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Server;
use tonic::transport::server::Connected;
use tonic::{Request, Response, Status, async_trait};

use self::demand::Pool;
use crate::connections::{Connections, Room, Visit, accepted};
use crate::rate_limited_log::RateLimitedLog;
use crate::schedule::{OpenWork, Quota, Tenant};
use crate::state::{State, stopped};
use crate::store::StoreError;
use crate::tls::Tls;

/// How long a look at the store answers for.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// KEDA has one connection for each of its objects, or fewer.
const ROOM: Room = Room { connections: 256, strangers: 64 };
/// Streams of StreamIsActive at a time; one more is refused.
const MAX_STREAMS: usize = 256;

/// One look at the store.
struct Look {
    taken: Instant,
    now_ms: u64,
    work: Vec<OpenWork>,
    quotas: HashMap<Tenant, Quota>,
}

impl Look {
    fn value(&self, pool: &Pool) -> u64 {
        pool.value(&self.work, |tenant| self.quotas.get(tenant).copied().unwrap_or_default(), self.now_ms)
    }
}

/// The service. It holds the coordinator weakly: a poll must not keep the store open.
#[derive(Clone)]
struct Scaler(Arc<Inner>);

struct Inner {
    shared: Weak<State>,
    last: Mutex<Option<Arc<Look>>>,
    streams: Arc<Semaphore>,
    /// Triggers with a fault. KEDA asks for each of them all the time.
    faults: RateLimitedLog,
}

impl Scaler {
    async fn look(&self) -> Result<Arc<Look>, Status> {
        let lock = || self.0.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = lock().as_ref().filter(|known| known.taken.elapsed() < LOOK_EVERY) {
            return Ok(Arc::clone(known));
        }
        let shared =
            self.0.shared.upgrade().ok_or_else(|| Status::unavailable("the coordinator is stopping"))?;
        let look = look_at(&shared).await.map_err(|error| Status::unavailable(error.to_string()))?;
        let look = Arc::new(look);
        *lock() = Some(Arc::clone(&look));
        Ok(look)
    }

    /// The pool of an object. KEDA shows the refusal in the status of the object.
    fn pool_of(&self, object: Option<&ScaledObjectRef>) -> Result<Pool, Status> {
        let object = object.ok_or_else(|| Status::invalid_argument("the call names no object"))?;
        Pool::of(&object.scaler_metadata).map_err(|fault| {
            if self.0.faults.count().is_some() {
                let (namespace, name) = (&object.namespace, &object.name);
                tracing::warn!(%namespace, %name, %fault, "KEDA's trigger has a fault");
            }
            Status::invalid_argument(format!("metadata of the trigger: {fault}"))
        })
    }

    async fn value(&self, pool: &Pool) -> Result<u64, Status> {
        Ok(self.look().await?.value(pool))
    }
}

async fn look_at(shared: &State) -> Result<Look, StoreError> {
    let (taken, now_ms, work) = (Instant::now(), shared.clock.now_ms(), shared.jobs.open_work().await?);
    let mut quotas = HashMap::new();
    for OpenWork { tenant, .. } in &work {
        if !quotas.contains_key(tenant) {
            quotas.insert(tenant.clone(), shared.store.quota(tenant).await?);
        }
    }
    Ok(Look { taken, now_ms, work, quotas })
}

#[async_trait]
impl ExternalScaler for Scaler {
    async fn is_active(
        &self,
        request: Request<ScaledObjectRef>,
    ) -> Result<Response<IsActiveResponse>, Status> {
        let pool = self.pool_of(Some(request.get_ref()))?;
        Ok(Response::new(IsActiveResponse { result: self.value(&pool).await? > 0 }))
    }

    type StreamIsActiveStream = ReceiverStream<Result<IsActiveResponse, Status>>;

    async fn stream_is_active(
        &self,
        request: Request<ScaledObjectRef>,
    ) -> Result<Response<Self::StreamIsActiveStream>, Status> {
        let pool = self.pool_of(Some(request.get_ref()))?;
        let place = Arc::clone(&self.0.streams).try_acquire_owned().map_err(|_| {
            Status::resource_exhausted(format!("{MAX_STREAMS} streams are open, and more are not served"))
        })?;
        let (say, answers) = mpsc::channel(1);
        let scaler = self.clone();
        tokio::spawn(async move {
            let _place = place;
            let mut said = None;
            while !say.is_closed() {
                let is_active = scaler.value(&pool).await.map(|value| value > 0);
                let now = is_active.as_ref().ok().copied();
                // After an error the stream ends, and KEDA opens another.
                if (now.is_none() || now != said)
                    && (say.send(is_active.map(|result| IsActiveResponse { result })).await.is_err()
                        || now.is_none())
                {
                    return;
                }
                said = now;
                tokio::time::sleep(LOOK_EVERY).await;
            }
        });
        Ok(Response::new(ReceiverStream::new(answers)))
    }

    async fn get_metric_spec(
        &self,
        request: Request<ScaledObjectRef>,
    ) -> Result<Response<GetMetricSpecResponse>, Status> {
        let pool = self.pool_of(Some(request.get_ref()))?;
        let spec = MetricSpec {
            metric_name: pool.count.metric().to_owned(),
            // For a target of 0 KEDA would start nothing.
            target_size: pool.tasks_per_worker.into(),
            target_size_float: pool.tasks_per_worker.into(),
        };
        Ok(Response::new(GetMetricSpecResponse { metric_specs: vec![spec] }))
    }

    async fn get_metrics(
        &self,
        request: Request<GetMetricsRequest>,
    ) -> Result<Response<GetMetricsResponse>, Status> {
        let pool = self.pool_of(request.get_ref().scaled_object_ref.as_ref())?;
        let value = self.value(&pool).await?;
        let value = MetricValue {
            metric_name: pool.count.metric().to_owned(),
            metric_value: i64::try_from(value).unwrap_or(i64::MAX),
            metric_value_float: value as f64,
        };
        Ok(Response::new(GetMetricsResponse { metric_values: vec![value] }))
    }
}

/// Serves the scaler until the coordinator stops.
pub async fn serve(shared: Arc<State>, listener: TcpListener, tls: Option<Arc<Tls>>) {
    let inner = Inner {
        shared: Arc::downgrade(&shared),
        last: Mutex::new(None),
        streams: Arc::new(Semaphore::new(MAX_STREAMS)),
        faults: RateLimitedLog::default(),
    };
    let mut stopping = shared.stopping.clone();
    drop(shared);
    let scaler = Scaler(Arc::new(inner));
    let connections = Connections::new(ROOM);
    let incoming = Arc::clone(&connections).of(accepted(listener));
    let served = async {
        match tls {
            None => run(scaler, incoming).await,
            Some(tls) => {
                let watched = Arc::clone(&tls);
                tokio::select! {
                    served = run(scaler, tls.over(incoming)) => served,
                    () = watched.watch() => Ok(()),
                }
            }
        }
    };
    tokio::select! {
        served = served => {
            if let Err(error) = served {
                tracing::error!(%error, "the scaler ended; KEDA starts no workers until the coordinator starts again");
            }
        }
        () = connections.watch() => {}
        () = stopped(&mut stopping) => {}
    }
}

async fn run<C, I>(scaler: Scaler, incoming: I) -> Result<(), tonic::transport::Error>
where
    C: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
    I: Stream<Item = io::Result<C>> + Send,
{
    // A call shows that the handshake was completed, or that no certificate is required.
    let admit = |request: Request<()>| {
        if let Some(visit) = Visit::in_extensions(request.extensions()) {
            visit.admit();
        }
        Ok(request)
    };
    Server::builder()
        .timeout(Duration::from_secs(30))
        .http2_keepalive_interval(Some(Duration::from_secs(20)))
        .add_service(ExternalScalerServer::with_interceptor(scaler, admit))
        .serve_with_incoming(incoming)
        .await
}
