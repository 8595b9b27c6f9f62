//! The invariants of a run: those of any history (`fathom-invariants` has the list), and two that need the
//! simulated machine. These are the age of files, and tokens in logs.

mod files;

use std::path::Path;

use fathom_coordinator::schedule::{Artifact, JobState, Tenant};
use fathom_coordinator::store::export::Export;
use fathom_core::scene::BlobRef;
use fathom_invariants::{Fact, Record};

use crate::scene::{config, kind_of};
use crate::world::{World, tenant_of};

/// The result of the checks.
#[derive(Default)]
pub struct Found {
    /// A sentence for each.
    pub violations: Vec<String>,
    /// Digests of the merged models, by the kind of their jobs.
    pub models: Vec<(String, String)>,
}

/// Checks a finished run.
pub fn look(world: &World) -> Found {
    let export = world.disk.lock().unwrap_or_else(std::sync::PoisonError::into_inner).synced();
    let facts = world.history.facts();
    let settings = world.coordinator_config();
    let record = Record {
        facts: &facts,
        export: &export,
        budgets: (settings.max_errors, settings.max_losses),
        all_end: true,
        loses_results: false,
        tenant_of: &|user| tenant_of(user).to_owned(),
        read: &|tenant: &Tenant, blob: &BlobRef| std::fs::read(files::path(world, tenant, &blob.digest)).ok(),
    };
    let mut violations = record.violations();
    files::look(world, &export, &mut violations);
    for job in &export.jobs {
        let kept = settings.data_dir.join("logs").join(job.job.job_id.as_str());
        lines_of(&kept).iter().for_each(|line| world.look_for_tokens(line));
    }
    let said = world.said_tokens();
    violations.extend(said.iter().map(|line| format!("I13: a token is in a log: {line}")));
    let count = |is_one: fn(&Fact) -> bool| facts.iter().filter(|(_, fact)| is_one(fact)).count() as u64;
    world.counts(|counts| {
        counts.jobs += export.jobs.len() as u64;
        counts.attempts += count(|fact| matches!(fact, Fact::Granted { .. }));
        counts.datasets += count(|fact| matches!(fact, Fact::Committed { .. }));
    });
    Found { violations, models: models(world, &record) }
}

/// Lines of all files in a folder and in those in it.
fn lines_of(folder: &Path) -> Vec<String> {
    let mut lines = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            lines.append(&mut lines_of(&path));
        } else {
            let text = std::fs::read(&path).unwrap_or_default();
            lines.extend(String::from_utf8_lossy(&text).lines().map(str::to_owned));
        }
    }
    lines
}

/// Merged models with their kinds: of jobs in the store, and of deleted jobs as they were downloaded.
fn models(world: &World, record: &Record) -> Vec<(String, String)> {
    let Export { jobs, .. } = record.export;
    let mut models = Vec::new();
    for job in jobs.iter().filter(|job| job.job.state == JobState::Succeeded) {
        if let Some(model) = job.job.output(Artifact::Model) {
            models.push((kind_of(&job.job.config_json), model.digest.clone()));
        }
    }
    for (_, fact) in record.facts {
        if let Fact::Fetched { user, job, model } = fact
            && record.deleted().contains(job)
        {
            let wanted = &world.scenario.jobs[*user];
            let config = serde_json::to_string(&config(wanted.partitions, wanted.variety));
            models.push((kind_of(&config.unwrap_or_default()), model.clone()));
        }
    }
    models
}
