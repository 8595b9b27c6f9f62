//! Workers that know several addresses, when the one in use dies.

use std::net::SocketAddr;
use std::sync::Arc;

use crate::support::{FakeTrainer, TestCluster};
use fathom_proto::v1;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{JoinHandle, JoinSet};

/// A way to a coordinator that can die with all of its connections.
struct Relay {
    address: SocketAddr,
    running: JoinHandle<()>,
}

impl Relay {
    async fn to(coordinator: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let running = tokio::spawn(async move {
            let mut connections = JoinSet::new();
            while let Ok((mut near, _)) = listener.accept().await {
                connections.spawn(async move {
                    let mut far = TcpStream::connect(coordinator).await?;
                    tokio::io::copy_bidirectional(&mut near, &mut far).await
                });
            }
        });
        Self { address, running }
    }

    async fn die(self) {
        self.running.abort();
        assert!(self.running.await.unwrap_err().is_cancelled());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_keeps_its_lease_when_its_address_dies() {
    let cluster = TestCluster::start().await;
    let (first, second) = (Relay::to(cluster.address()).await, Relay::to(cluster.address()).await);
    let urls = format!("http://{},http://{}", first.address, second.address);
    let worker = cluster.worker_at(&urls, FakeTrainer::slow());
    let job = cluster.submit("moved", 1).await;
    let partition =
        |job: &v1::Job| job.tasks.iter().find(|task| task.task_id == "partition-0000").cloned().unwrap();
    let has_begun = |job: &v1::Job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0);
    let begun = cluster.wait_for(&job, has_begun).await;
    assert_eq!(partition(&begun).state(), v1::TaskState::Leased);
    first.die().await;
    let done = cluster.wait_for(&job, |job| job.state() == v1::JobState::Succeeded).await;
    let task = partition(&done);
    assert_eq!((task.attempts, task.errors, task.losses), (1, 0, 0), "{task:?}");
    assert_eq!(cluster.workers().await.len(), 1, "it has kept its incarnation");
    worker.leave().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_idle_worker_moves_and_takes_the_next_task() {
    let cluster = TestCluster::start().await;
    let (first, second) = (Relay::to(cluster.address()).await, Relay::to(cluster.address()).await);
    let urls = format!("http://{},http://{}", first.address, second.address);
    let trainer = FakeTrainer::quick();
    let worker = cluster.worker_at(&urls, Arc::clone(&trainer));
    let job = cluster.submit("before", 1).await;
    cluster.wait_for(&job, |job| job.state() == v1::JobState::Succeeded).await;
    // Its claim waits in the coordinator by now, or soon.
    first.die().await;
    let job = cluster.submit("after", 1).await;
    cluster.wait_for(&job, |job| job.state() == v1::JobState::Succeeded).await;
    worker.leave().await;
}
