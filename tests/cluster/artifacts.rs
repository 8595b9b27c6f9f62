//! The files of a job, page by page.

use crate::support::{FakeTrainer, TestCluster, reason_of};
use fathom_proto::v1;
use tonic::Code;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn artifacts_are_paged_and_a_wrong_page_token_is_refused() {
    let cluster = TestCluster::start().await;
    let _worker = cluster.worker(FakeTrainer::quick());
    let mut jobs = Vec::new();
    for (name, columns) in [("first", 1), ("second", 2)] {
        let job = cluster.submit(name, columns).await;
        assert_eq!(cluster.finished(&job).await.state(), v1::JobState::Succeeded);
        jobs.push(job);
    }
    let all = cluster.list_artifacts(&jobs[0], 0).await;
    assert_eq!(all.len(), 1);
    assert!(all[0].len() > 7 && all[0].is_sorted_by(|a, b| a.path < b.path), "{all:#?}");
    for page_size in [1, 3, all[0].len() as u32, 2000] {
        let pages = cluster.list_artifacts(&jobs[0], page_size).await;
        assert_eq!(pages.len(), all[0].len().div_ceil(page_size as usize), "pages of {page_size}");
        assert_eq!(pages.concat(), all[0]);
    }

    let list = async |job_id: &str, page_token: &str| {
        let (job_id, page_token) = (job_id.to_owned(), page_token.to_owned());
        let request = v1::ListArtifactsRequest { job_id, page_size: 3, page_token };
        cluster.jobs().list_artifacts(request).await.map(tonic::Response::into_inner)
    };
    let token = list(&jobs[0], "").await.unwrap().next_page_token;
    assert!(token.starts_with("3-"), "{token}");
    let waiting = cluster.submit("waits", 1).await;
    let cases = [
        (&jobs[0], "x"),
        (&jobs[0], "3-00000000"),
        (&jobs[0], &token.replace('3', "4")),
        (&jobs[0], &format!("{token}-")),
        (&jobs[1], &token),
        (&waiting, &token),
    ];
    for (job, wrong) in cases {
        let refused = list(job, wrong).await.unwrap_err();
        assert_eq!(
            (refused.code(), reason_of(&refused).as_str()),
            (Code::InvalidArgument, "BAD_ARGUMENT"),
            "{wrong}"
        );
    }
}
