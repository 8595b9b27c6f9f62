//! What a coordinator keeps, and whether it keeps all that it acknowledged.

use std::path::Path;
use std::process::Output;
use std::time::Duration;

use fathom_coordinator::CoordinatorConfig;
use fathom_coordinator::schedule::Tenant;
use fathom_coordinator::store::export::Export;
use fathom_core::scene::BlobRef;
use fathom_invariants::{Fact, Record};

use super::{Harness, PREFIX};
use crate::history::{History, acknowledged};
use crate::job::Job;
use crate::processes::output_in;

impl Harness {
    /// As [`Harness::succeeded`]; then checks everything that the coordinator keeps.
    pub fn conclude(mut self, job: &Job) -> History {
        let history = self.succeeded(job);
        self.check_what_is_kept();
        history
    }

    /// Kills the coordinator a last time. All blobs are then intact, and the invariants hold for the store
    /// and for all that clients and workers were answered.
    pub fn check_what_is_kept(&mut self) {
        // Processes that were already killed stay dead.
        self.workers.clear();
        self.second = None;
        self.kill_coordinator();
        let found = self.offline("verify", &["--deep", "--json"]);
        let said = String::from_utf8_lossy(&found.stdout).into_owned();
        assert!(found.status.success(), "the coordinator left damaged data: {said}");
        let violations = self.violations();
        assert!(violations.is_empty(), "{violations:#?}");
    }

    /// Runs a verb of `fathom store` on what a stopped coordinator keeps.
    fn offline(&self, verb: &str, more: &[&str]) -> Output {
        let data = self.data.to_string_lossy().into_owned();
        let mut words = vec!["store", verb, "--data-dir", &data];
        if let Some((_, url)) = &self.database {
            words.extend(["--store", url]);
        }
        let objects = self.bucket.as_ref().map(|bucket| format!("--objects={}", bucket.url(PREFIX)));
        words.extend(objects.as_deref().filter(|_| verb == "verify"));
        words.extend(more);
        output_in(&self.environment(), &words)
    }

    fn violations(&self) -> Vec<String> {
        let file = self.path("at-the-end.export");
        let found = self.offline("export", &["-o", &file]);
        assert!(found.status.success(), "no export: {}", String::from_utf8_lossy(&found.stderr));
        let export = Export::read(Path::new(&file)).expect("an export");
        let workers: Vec<_> = self.logs().into_iter().filter(|(name, _)| !is_coordinator(name)).collect();
        let logged = workers.iter().flat_map(|(_, log)| acknowledged(log));
        let facts: Vec<_> =
            self.facts.iter().cloned().chain(logged.map(|fact| (Duration::ZERO, fact))).collect();
        let is_logged = |fact: &Fact| matches!(fact, Fact::CheckpointSafe { .. } | Fact::ResultTaken { .. });
        assert!(
            self.succeeded == 0 || facts.iter().any(|(_, fact)| is_logged(fact)),
            "the worker logs hold no acknowledgements: has their format changed?"
        );
        let record = Record {
            facts: &facts,
            export: &export,
            budgets: (CoordinatorConfig::default().max_errors, self.rules.max_losses as u32),
            all_end: self.ended == self.watched,
            loses_results: true,
            tenant_of: &|_| Tenant::default().to_string(),
            read: &|tenant: &Tenant, blob: &BlobRef| std::fs::read(self.blob(tenant, blob)).ok(),
        };
        record.violations()
    }
}

fn is_coordinator(log: &str) -> bool {
    ["coordinator", "second-coordinator"].contains(&log)
}
