#!/usr/bin/env python3
"""Removes one safeguard after another and checks that a named test notices.

    scripts/mutants.py [WORD ...]     mutants with one of the words in their names; default: all

Every mutant changes one line in a copy of the committed tree (a worktree under the target folder), compiled without
optimisation. Its guarding tests all pass before the first mutant. The table goes to stdout, and the number of noticed
mutants to bench/history.jsonl. Exits with 1 if a mutant survives, or if a line is not found.
"""

import json
import os
import pathlib
import subprocess
import sys
import time

import history

ROOT = pathlib.Path(__file__).resolve().parent.parent
SRC = "coordinator/src/"
CONFORMANCE = "store::conformance::"

SEEDS = "invariants_hold_despite_crashes_cuts_and_repeats"

# Name, file, original line, replacement, test target (of the coordinator, or PACKAGE/TARGET), test.
MUTANTS = [
    (
        "fences are not checked",
        SRC + "schedule/scheduler.rs",
        "if record.is_held_by(lease) || rules.ignores_fences() {",
        "if true {",
        "lib",
        CONFORMANCE + "sled::a_silent_worker_loses_its_lease_and_late_messages_fail",
    ),
    (
        "replies do not wait for the sync",
        SRC + "store/flusher.rs",
        "answer.await.map_err(|_| gone())?.map_err(StoreError::Failed)",
        "drop(answer);\n        Ok(())",
        "lib",
        CONFORMANCE + "sync::no_reply_leaves_before_its_sync_has_returned",
    ),
    (
        "nothing is synced",
        SRC + "store/flusher.rs",
        "None => disk.sync(),",
        "None => Ok(()),",
        "lib",
        CONFORMANCE + "sync::acknowledged_data_survives_a_crash_that_loses_all_else",
    ),
    (
        "readers do not wait for the sync",
        SRC + "store/flusher.rs",
        "if self.is_synced() { Ok(()) } else { self.sync().await }",
        "Ok(())",
        "lib",
        "store::flusher::tests::a_read_counts_as_safe_only_after_the_sync_of_its_write",
    ),
    (
        "requests are not remembered",
        SRC + "store/sled/changes.rs",
        'if let Some(id) = tx.get::<JobId>("requests", tx.requests, request.as_bytes())? {',
        "if let Some(id) = None::<JobId> {",
        "lib",
        CONFORMANCE + "sled::one_request_makes_one_job",
    ),
    (
        "lost workers are not counted",
        SRC + "schedule/scheduler.rs",
        "Some(FailClass::Environment) => record.losses += 1,",
        "Some(FailClass::Environment) => {}",
        "lib",
        CONFORMANCE + "sled::budgets_end_a_poisoned_job",
    ),
    (
        "errors are not counted",
        SRC + "schedule/scheduler.rs",
        "Some(_) => record.errors += 1,",
        "Some(_) => {}",
        "lib",
        CONFORMANCE + "sled::budgets_end_a_poisoned_job",
    ),
    (
        "silent workers keep their leases",
        SRC + "store/sled/changes.rs",
        "let expired = live.leases.expired(now_ms, self.stall_ms);",
        "let expired: Vec<(Lease, Expired)> = Vec::new();",
        "lib",
        CONFORMANCE + "sled::a_silent_worker_loses_its_lease_and_late_messages_fail",
    ),
    (
        "the queue does not follow the rows",
        SRC + "store/sled/live.rs",
        "self.queue.note(job, rows.tasks.values());",
        "",
        "lib",
        "store::sled::tests::the_queue_matches_the_rows_after_concurrent_changes",
    ),
    (
        "digests of uploads are not checked",
        SRC + "objects/writer.rs",
        "if found.as_str() != self.blob.digest {",
        "if false {",
        "lib",
        "objects::tests::bytes_that_differ_from_the_declaration_are_deleted",
    ),
    (
        "digests are not checked when blobs are read",
        SRC + "objects/mod.rs",
        "if blake3::hash(&bytes).to_hex().as_str() == blob.digest {",
        "if true {",
        "lib",
        "objects::tests::a_blob_that_changed_on_the_disk_is_noticed_by_its_reader",
    ),
    (
        "blobs referenced by jobs are garbage",
        SRC + "objects/garbage.rs",
        "if check_digest(&name).is_err() || used.contains(&name) {",
        "if check_digest(&name).is_err() || used.is_empty() {",
        "seeds",
        SEEDS,
    ),
    (
        "blobs named by a manifest are garbage",
        SRC + "retention.rs",
        "Ok(bytes) => used.extend(digests_in(&bytes)),",
        "Ok(bytes) => drop(bytes),",
        "seeds",
        SEEDS,
    ),
    (
        "jobs are accepted without their photographs",
        SRC + "services/manifests.rs",
        "if !objects.contains(&blob).await? {",
        "if false && !objects.contains(&blob).await? {",
        "cluster",
        "jobs::one_request_makes_one_job_and_names_a_missing_photograph",
    ),
    (
        "tenants get more than they may",
        SRC + "schedule/queue.rs",
        "candidates.retain(|(_, job)| !is_at_its_limit(&job.tenant));",
        "let _ = is_at_its_limit;",
        "lib",
        CONFORMANCE + "sled::a_tenant_stays_within_its_quota",
    ),
    (
        "a second worker keeps its lease when the task ends",
        SRC + "schedule/task.rs",
        "self.second = None;",
        "",
        "lib",
        CONFORMANCE + "sled::a_slow_task_gets_a_second_worker_and_the_first_result_counts",
    ),
    (
        "every worker is slow after a while",
        SRC + "schedule/straggler.rs",
        "(self.straggler_factor * usual_ms).max(self.straggler_after_ms as f64)",
        "(0.0 * usual_ms).max(self.straggler_after_ms as f64)",
        "lib",
        "schedule::straggler::tests::attempt_is_slow_at_3x_median_of_siblings",
    ),
    (
        "tokens are known by their ids",
        SRC + "access/token.rs",
        "stored.is_ok_and(|stored| stored == token.digest()) && self.id == token.id",
        "stored.is_ok() && self.id == token.id",
        "lib",
        "access::table::tests::only_a_valid_token_is_admitted",
    ),
    (
        "tenants see each other",
        SRC + "access/mod.rs",
        "self.tenant.as_ref().is_none_or(|own| own == tenant)",
        "self.tenant.is_none() || !tenant.as_str().is_empty()",
        "cluster",
        "access::a_tenant_sees_nothing_of_another_whatever_it_asks",
    ),
    (
        "roles are not asked",
        SRC + "access/guard.rs",
        "if !may(&caller, service, method) {",
        "if !may(&caller, service, method) && caller.name.is_empty() {",
        "cluster",
        "access::a_role_permits_its_own_calls_and_no_others",
    ),
    (
        "revoked tokens end nothing that lasts",
        SRC + "access/guard.rs",
        "Box::pin(async move { access.until_void(&caller, clock).await })",
        "Box::pin(async move { drop((access, clock, caller)); std::future::pending().await })",
        "cluster",
        "hostile::a_revoked_token_ends_an_upload_that_is_under_way",
    ),
    (
        "a connection that is never read outlives its token",
        SRC + "access/calls.rs",
        "visit.end();",
        "",
        "cluster",
        "hostile::a_revoked_token_ends_a_download_however_slowly_it_is_read",
    ),
    (
        "an incarnation is anybody's",
        SRC + "worker_registry.rs",
        "if known.is_some_and(|known| known.owner.token_id != worker.owner.token_id) {",
        "if known.is_some_and(|known| known.owner.token_id != worker.owner.token_id && known.adapter == \"x\") {",
        "cluster",
        "hostile::an_incarnation_belongs_only_to_the_token_that_registered_it",
    ),
    (
        "unfinished uploads count nothing",
        SRC + "objects/declared.rs",
        "self.total = self.total.saturating_sub(before.unwrap_or(0)).saturating_add(bytes);",
        "drop(before);",
        "cluster",
        "hostile::uploads_count_from_their_first_message_even_in_a_burst",
    ),
    (
        "idle uploads keep their blob",
        SRC + "access/calls.rs",
        "let patience = (kind != Kind::Session).then(",
        "let patience = false.then(",
        "cluster",
        "hostile::a_silent_upload_ends_and_lets_another_continue",
    ),
    (
        "strangers have any time and any number",
        SRC + "connections/mod.rs",
        "while all.strangers.len() >= self.room.strangers || all.open >= self.room.connections {",
        "while false {",
        "cluster",
        "hostile::silent_connections_block_nobody_and_close_after_ten_seconds",
    ),
    (
        "snapshots that sled did not finish stay in its way",
        SRC + "store/sled/snapshots.rs",
        "return Ok(Some(UNDONE));",
        "return Ok(None);",
        "lib",
        "store::sled::tests::a_truncated_snapshot_is_set_aside_and_no_row_is_missing",
    ),
    (
        "snapshots that sled cannot read stay in its way",
        SRC + "store/sled/snapshots.rs",
        "(!is_whole(&fs::read(path)?)).then_some(",
        "(!is_whole(&fs::read(path)?) && path.is_dir()).then_some(",
        "lib",
        "store::sled::tests::a_snapshot_with_a_flipped_bit_is_made_again_from_the_log",
    ),
    (
        "read-only commands open the store itself",
        SRC + "store/sled/copy.rs",
        "let options = SledOptions { dir: copy.path().to_owned(), ..options.clone() };",
        "let options = options.clone();",
        "lib",
        "store::sled::tests::read_only_access_opens_a_copy_and_changes_no_byte",
    ),
    (
        "files from the future are for ever",
        SRC + "objects/garbage.rs",
        "if modified > now {",
        "if false {",
        "lib",
        "objects::tests::files_from_the_future_count_as_made_now",
    ),
]


def run(command, **options):
    return subprocess.run(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False, **options)


def must(command, **options):
    done = run(command, **options)
    if done.returncode != 0:
        sys.exit(f"mutants: {' '.join(map(str, command))}: {done.stdout[-2000:]}")
    return done.stdout


def test(tree, environment, target, names):
    """Runs tests by their full names; returns whether it compiled, whether all passed, and the output."""
    package = {"lib": "coordinator", "seeds": "simulation", "cluster": "cli"}.get(target, "coordinator")
    where = ["--lib"] if target == "lib" else ["--test", target]
    command = ["cargo", "test", "-p", f"fathom-{package}", *where, "--", "--exact", *names]
    done = run(command, cwd=tree, env=environment)
    compiled = "Running " in done.stdout
    ran = done.stdout.count("\ntest ")
    if compiled and ran < len(names):
        sys.exit(f"mutants: {len(names)} tests were named and {ran} found: {names}")
    return compiled, done.returncode == 0, done.stdout


def main():
    words = sys.argv[1:]
    chosen = [mutant for mutant in MUTANTS if not words or any(word in mutant[0] for word in words)]
    if not chosen:
        sys.exit(f"mutants: none has {words} in its name")
    target = json.loads(must(["cargo", "metadata", "--no-deps", "--format-version", "1"], cwd=ROOT).splitlines()[-1])
    target = pathlib.Path(target["target_directory"])
    tree = target / "mutants"
    run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT)
    must(["git", "worktree", "prune"], cwd=ROOT)
    must(["git", "worktree", "add", "--detach", "--force", str(tree), "HEAD"], cwd=ROOT)
    environment = dict(
        os.environ,
        CARGO_TARGET_DIR=str(target),
        CARGO_PROFILE_DEV_OPT_LEVEL="0",
        CARGO_TERM_COLOR="never",
        FATHOM_SIMULATION_SEEDS="60",
    )
    try:
        for kind in sorted({mutant[4] for mutant in chosen}):
            names = sorted({mutant[5] for mutant in chosen if mutant[4] == kind})
            _, passed, said = test(tree, environment, kind, names)
            if not passed:
                sys.exit(f"mutants: the tests fail without any mutant: {said[-3000:]}")
        print("| when | it is noticed by | s |\n|---|---|---|", flush=True)
        alive = 0
        for name, file, line, instead, kind, guard in chosen:
            begin = time.monotonic()
            path = tree / file
            text = path.read_text()
            if text.count(line) != 1:
                sys.exit(f"mutants: {name}: {text.count(line)} lines of {file} are {line!r}")
            path.write_text(text.replace(line, instead))
            compiled, passed, said = test(tree, environment, kind, [guard])
            path.write_text(text)
            if not compiled:
                sys.exit(f"mutants: {name}: it does not compile: {said[-3000:]}")
            alive += passed
            verdict = "**nothing**" if passed else f"`{guard.split('::')[-1]}`"
            print(f"| {name} | {verdict} | {time.monotonic() - begin:.0f} |", flush=True)
    finally:
        run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT)
    numbers = {"mutants": len(chosen), "noticed": len(chosen) - alive}
    history.append("mutants", " ".join(["scripts/mutants.py", *words]), numbers, adapter="none")
    sys.exit(1 if alive else 0)


if __name__ == "__main__":
    main()
