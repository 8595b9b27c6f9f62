//! Requirements on logs, tested with files and with a database, and those of one of them.

use std::fs;

use super::*;
use crate::schedule::{Rules, Stage};
use crate::store::conformance::postgres_server::{Disk, Server, database};
use crate::store::{PostgresOptions, PostgresStore};

const NOW_MS: u64 = 1_700_000_000_000;
const ALL: Wanted = Wanted::ALL;
const FIRST: Attempt = (Stage::Partition.task_of(3), 1);

/// Where logs lie; each opening is a process of its own.
enum Kept {
    InFiles(tempfile::TempDir),
    InDatabase(String),
}

impl Kept {
    async fn open(&self, attempt_bytes: u64) -> Arc<dyn Logs> {
        match self {
            Self::InFiles(dir) => Arc::new(JobLogs::new(dir.path(), attempt_bytes)),
            Self::InDatabase(url) => postgres(url).await.logs(attempt_bytes).expect("the database has logs"),
        }
    }

    /// Bytes of all lines.
    async fn bytes(&self) -> u64 {
        match self {
            Self::InFiles(dir) => {
                let files = fs::read_dir(dir.path().join(job().as_str())).unwrap();
                files.map(|entry| entry.unwrap().metadata().unwrap().len()).sum()
            }
            Self::InDatabase(url) => {
                let lines = "SELECT coalesce(sum(pg_column_size(log_lines.*)), 0) FROM log_lines";
                let pool = sqlx::PgPool::connect(url).await.unwrap();
                let sum: i64 = sqlx::query_scalar(lines).fetch_one(&pool).await.unwrap();
                sum.unsigned_abs()
            }
        }
    }
}

async fn postgres(url: &str) -> PostgresStore {
    let options = PostgresOptions {
        url: url.to_owned(),
        rules: Rules::default(),
        lease_ms: 1000,
        stall_ms: 0,
        connections: 8,
    };
    PostgresStore::open_with_own_clock(&options).await.unwrap()
}

fn job() -> JobId {
    JobId::new(NOW_MS, 7)
}

fn line(from_worker: u64, message: &str) -> NewLine {
    NewLine {
        from_worker: Some(from_worker),
        time_ms: NOW_MS,
        severity: Severity::Info,
        message: message.into(),
    }
}

/// Everything after a number, in pages of `limit`.
async fn read_after(logs: &dyn Logs, wanted: &Wanted, number: u64, limit: usize) -> Vec<KeptLine> {
    let (mut position, mut more) = (Position::after(number), true);
    let mut all = Vec::new();
    while more {
        let lines;
        Page { lines, position, more } = logs.read(&job(), wanted, position, limit).await.unwrap();
        assert!(lines.len() <= limit);
        all.extend(lines);
    }
    all
}

fn messages(lines: &[KeptLine]) -> Vec<&str> {
    lines.iter().map(|line| line.row.message.as_str()).collect()
}

fn assert_ascending(lines: &[KeptLine]) {
    assert!(lines.windows(2).all(|pair| pair[0].row.number < pair[1].row.number));
}

async fn lines_arrive_in_order_and_once_wherever_a_reader_resumes(kept: Kept) {
    let logs = kept.open(4 << 20).await;
    let attempts = [FIRST, (Stage::Merge.task(), 1), (Stage::Partition.task_of(3), 2)];
    for index in 0..200_u64 {
        let attempt = attempts[(index * index % 7 % 3) as usize];
        let mut new = line(index + 1, &index.to_string());
        new.severity = if index % 10 == 0 { Severity::Warn } else { Severity::Info };
        logs.append(&job(), attempt, ("w", 1), vec![new], NOW_MS + index / 20).await.unwrap();
    }
    let logs = logs.as_ref();
    let all = read_after(logs, &ALL, 0, 7).await;
    let expected: Vec<String> = (0..200).map(|index| index.to_string()).collect();
    assert_eq!(messages(&all), expected);
    assert_ascending(&all);
    for from in [0, 1, 57, 198, 199] {
        let after = all[from].row.number;
        assert_eq!(read_after(logs, &ALL, after, 50).await, all[from + 1..]);
    }
    let warnings = Wanted { severity: Severity::Warn, ..ALL };
    assert_eq!(read_after(logs, &warnings, 0, 3).await.len(), 20);
    let of_second = Wanted { task: Some(Stage::Partition.task_of(3)), attempt: Some(2), ..ALL };
    let kept: Vec<KeptLine> = all.iter().filter(|line| line.attempt == 2).cloned().collect();
    assert!(!kept.is_empty());
    assert_eq!(read_after(logs, &of_second, 0, 10).await, kept);
    assert_eq!(logs.last(&job()).await.unwrap(), all[199].row.number);
}

async fn a_repeated_line_is_stored_once_even_across_a_restart(kept: Kept) {
    let mut before = 0;
    for run in 0..3 {
        // A wall clock that is set back between two runs.
        let now_ms = NOW_MS - run * 1000;
        let logs = kept.open(4 << 20).await;
        for _ in 0..2 {
            let lines = (1..=2 * (run + 1)).map(|number| line(number, &number.to_string())).collect();
            logs.append(&job(), FIRST, ("w", 1), lines, now_ms).await.unwrap();
        }
        let own = NewLine { from_worker: None, ..line(0, "of the coordinator") };
        logs.append(&job(), FIRST, ("coordinator", 0), vec![own], now_ms).await.unwrap();
        let new = read_after(logs.as_ref(), &ALL, before, 100).await;
        let [first, second] = [2 * run + 1, 2 * run + 2].map(|number| number.to_string());
        assert_eq!(messages(&new), [first.as_str(), &second, "of the coordinator"]);
        before = new.last().unwrap().row.number;
        assert_eq!(logs.jobs().await.unwrap(), [job()]);
    }
}

async fn a_long_attempt_keeps_its_first_and_latest_lines(kept: Kept) {
    const BOUND: u64 = 64 << 10;
    let logs = kept.open(BOUND).await;
    let mut follower = Position::default();
    let mut followed = Vec::new();
    for batch in 0..100_u64 {
        let lines = (1..=50).map(|index| line(batch * 50 + index, &format!("line {}", batch * 50 + index)));
        logs.append(&job(), FIRST, ("w", 1), lines.collect(), NOW_MS + batch).await.unwrap();
        let page = logs.read(&job(), &ALL, follower, usize::MAX).await.unwrap();
        followed.extend(page.lines);
        follower = page.position;
    }
    let bytes = kept.bytes().await;
    assert!(bytes <= BOUND, "{bytes} bytes");
    let expected: Vec<String> = (1..=5000).map(|number| format!("line {number}")).collect();
    assert_eq!(messages(&followed), expected, "a reader that keeps up misses nothing");

    for logs in [logs, kept.open(BOUND).await] {
        let logs = logs.as_ref();
        let lines = read_after(logs, &ALL, 0, 64).await;
        let all = messages(&lines);
        assert_eq!((all[0], *all.last().unwrap()), ("line 1", "line 5000"));
        let cuts: Vec<usize> = (0..all.len()).filter(|&index| all[index].contains("removed here")).collect();
        assert_eq!(cuts.len(), 1, "{cuts:?}");
        assert!(all.len() > 180, "{} lines are left", all.len());
        let after_cut = lines[cuts[0]].row.number;
        assert_eq!(read_after(logs, &ALL, after_cut, 64).await, lines[cuts[0] + 1..]);
        assert_ascending(&lines);
        for limit in [1, cuts[0], cuts[0] + 1, cuts[0] + 2] {
            assert_eq!(read_after(logs, &ALL, 0, limit).await, lines, "pages of {limit}");
        }
        let warnings = Wanted { severity: Severity::Warn, ..ALL };
        assert_eq!(read_after(logs, &warnings, 0, 10).await, [lines[cuts[0]].clone()]);
    }
}

async fn old_attempts_of_a_task_and_deleted_jobs_leave_nothing(kept: Kept) {
    let logs = kept.open(4 << 20).await;
    let logs = logs.as_ref();
    for attempt in 1..=40 {
        for task in [Stage::Global.task(), Stage::Partition.task_of(0)] {
            let holder = ("w", u64::from(attempt));
            logs.append(&job(), (task, attempt), holder, vec![line(1, "x")], NOW_MS).await.unwrap();
        }
    }
    let left = read_after(logs, &ALL, 0, 1000).await;
    assert_eq!(left.len() as u32, 2 * ATTEMPTS_KEPT);
    assert!(left.iter().all(|line| line.attempt > 40 - ATTEMPTS_KEPT));
    let own = NewLine { from_worker: None, ..line(0, "of the coordinator") };
    logs.append(&job(), (Stage::Global.task(), 40), ("coordinator", 41), vec![own], NOW_MS).await.unwrap();
    for (fence, expected) in [(40, Some("w")), (39, None), (41, None)] {
        let found = logs.holder(&job(), (Stage::Global.task(), 40), fence).await.unwrap();
        assert_eq!(found.as_deref(), expected, "fence {fence}");
    }
    logs.remove(&job()).await.unwrap();
    assert_eq!(read_after(logs, &ALL, 0, 10).await, []);
    assert_eq!(logs.jobs().await.unwrap(), []);
    logs.remove(&job()).await.unwrap();
}

async fn a_history_is_replaced_and_removed_with_its_job(kept: Kept) {
    let logs = kept.open(4 << 20).await;
    let tasks = [Stage::Global.task(), Stage::Partition.task_of(3), Stage::Partition.task_of(12)];
    assert_eq!(logs.histories(&job(), None).await.unwrap(), []);
    for round in 0..3_u8 {
        for (index, task) in tasks.iter().rev().enumerate() {
            logs.put_history(&job(), *task, vec![round, index as u8]).await.unwrap();
        }
    }
    // A line beside them changes nothing, and they are no lines.
    logs.append(&job(), FIRST, ("w", 1), vec![line(1, "x")], NOW_MS).await.unwrap();
    let expected: Vec<_> = tasks.iter().zip([2, 1, 0]).map(|(task, index)| (*task, vec![2, index])).collect();
    let logs = kept.open(4 << 20).await;
    assert_eq!(logs.histories(&job(), None).await.unwrap(), expected);
    assert_eq!(logs.histories(&job(), Some(tasks[1])).await.unwrap(), expected[1..2]);
    assert_eq!(logs.histories(&job(), Some(Stage::Merge.task())).await.unwrap(), []);
    assert_eq!(messages(&read_after(logs.as_ref(), &ALL, 0, 10).await), ["x"]);

    let folder = tempfile::tempdir().unwrap();
    let copied = JobLogs::new(folder.path(), 4 << 20);
    assert_eq!(copy(logs.as_ref(), &copied).await.unwrap(), 1);
    assert_eq!(copied.histories(&job(), None).await.unwrap(), expected);

    logs.remove(&job()).await.unwrap();
    assert_eq!(logs.histories(&job(), None).await.unwrap(), []);
    logs.put_history(&job(), tasks[0], vec![1]).await.unwrap();
    assert_eq!(logs.jobs().await.unwrap(), [job()], "a late history is found by garbage collection");
}

async fn a_reader_beside_many_writers_sees_every_line_once_in_order(kept: Kept) {
    // Of a database: two coordinators.
    let logs = match &kept {
        Kept::InFiles(_) => {
            let logs = kept.open(64 << 20).await;
            [Arc::clone(&logs), logs]
        }
        Kept::InDatabase(_) => [kept.open(64 << 20).await, kept.open(64 << 20).await],
    };
    let writers = (0..4_u32).map(|index| {
        let logs = Arc::clone(&logs[index as usize % 2]);
        tokio::spawn(async move {
            for number in 1..=500 {
                let attempt = (Stage::Partition.task_of(index), 1);
                let lines = vec![line(number, "x")];
                logs.append(&job(), attempt, ("w", 1), lines, NOW_MS + number).await.unwrap();
            }
        })
    });
    let mut writers = Box::pin(futures::future::join_all(writers.collect::<Vec<_>>()));
    let (mut position, mut seen, mut done) = (Position::default(), Vec::new(), false);
    loop {
        let page = logs[1].read(&job(), &ALL, position, 17).await.unwrap();
        position = page.position;
        seen.extend(page.lines);
        if done && !page.more {
            break;
        }
        done = done || futures::FutureExt::now_or_never(&mut writers).is_some();
    }
    assert_eq!(seen.len(), 2000);
    assert_ascending(&seen);
}

async fn a_copy_has_the_same_lines_and_numbers_and_goes_on(kept: Kept) {
    const BOUND: u64 = 64 << 10;
    let from = kept.open(BOUND).await;
    for batch in 0..60_u64 {
        let lines = (1..=50).map(|index| line(batch * 50 + index, &format!("line \0 {batch} {index}")));
        from.append(&job(), FIRST, ("w\0", 1), lines.collect(), NOW_MS + batch).await.unwrap();
        let own = NewLine { from_worker: None, severity: Severity::Debug, ..line(0, "own") };
        from.append(&job(), (Stage::Merge.task(), 2), ("c", 0), vec![own], NOW_MS + batch).await.unwrap();
    }
    let expected = read_after(from.as_ref(), &ALL, 0, 256).await;
    assert!(expected.iter().any(|line| line.row.is_notice()), "nothing was removed");
    let mut others = vec![Kept::InFiles(tempfile::tempdir().unwrap())];
    others.extend(database().map(Kept::InDatabase));
    for other in others {
        // An interrupted copy.
        let to = other.open(BOUND).await;
        let first: Vec<KeptLine> = expected.iter().take(100).cloned().collect();
        to.import(&job(), first).await.unwrap();
        let to = other.open(BOUND).await;
        let copied = copy(from.as_ref(), to.as_ref()).await.unwrap();
        assert_eq!(copied as usize, expected[100..].iter().filter(|line| !line.row.is_notice()).count());
        assert_eq!(read_after(to.as_ref(), &ALL, 0, 64).await, expected);
        assert_eq!(copy(from.as_ref(), to.as_ref()).await.unwrap(), 0, "it is repeatable");
        // The worker repeats its latest lines there, and the attempt stays within its limit.
        for batch in 59..200_u64 {
            let lines = (1..=50).map(|index| line(batch * 50 + index, &format!("line \0 {batch} {index}")));
            to.append(&job(), FIRST, ("w", 2), lines.collect(), NOW_MS + batch).await.unwrap();
        }
        let of_first = Wanted { task: Some(FIRST.0), ..ALL };
        let lines = read_after(to.as_ref(), &of_first, 0, 64).await;
        assert_eq!(
            (lines[0].row.from_worker, lines.last().unwrap().row.from_worker),
            (Some(1), Some(10_000))
        );
        assert_ascending(&lines);
        let from_worker: Vec<u64> = lines.iter().filter_map(|line| line.row.from_worker).collect();
        assert!(from_worker.windows(2).all(|pair| pair[0] < pair[1]), "a line is there twice");
        assert_eq!(lines.iter().filter(|line| line.row.is_notice()).count(), 1);
    }
}

macro_rules! over_both {
    ($($name:ident),* $(,)?) => {
        mod files {
            use super::*;
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $name() {
                super::$name(Kept::InFiles(tempfile::tempdir().unwrap())).await;
            })*
        }
        mod postgres {
            use super::*;
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $name() {
                let Some(url) = database() else { return };
                super::$name(Kept::InDatabase(url)).await;
            })*
        }
    };
}

over_both!(
    lines_arrive_in_order_and_once_wherever_a_reader_resumes,
    a_repeated_line_is_stored_once_even_across_a_restart,
    a_long_attempt_keeps_its_first_and_latest_lines,
    old_attempts_of_a_task_and_deleted_jobs_leave_nothing,
    a_history_is_replaced_and_removed_with_its_job,
    a_reader_beside_many_writers_sees_every_line_once_in_order,
    a_copy_has_the_same_lines_and_numbers_and_goes_on,
);

#[tokio::test]
async fn only_a_line_that_a_crash_truncated_is_skipped() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(job().as_str()).join("partition-0003.1.0");
    let logs = JobLogs::new(dir.path(), 4 << 20);
    let lines = || vec![line(1, "a"), line(2, "b"), line(3, "c")];
    logs.append(&job(), FIRST, ("w", 1), lines(), NOW_MS).await.unwrap();
    let whole = fs::read(&path).unwrap();
    let second = whole.iter().position(|&b| b == b'\n').unwrap() + 1;
    let third = second + whole[second..].iter().position(|&b| b == b'\n').unwrap() + 1;
    for cut in [1, second - 1, second, second + 5, third - 1, third, third + 1, whole.len() - 1] {
        fs::write(&path, &whole[..cut]).unwrap();
        let logs = JobLogs::new(dir.path(), 4 << 20);
        let kept = [second, third, whole.len()].iter().filter(|&&end| end <= cut).count();
        let expected = ["a", "b", "c"];
        assert_eq!(messages(&read_after(&logs, &ALL, 0, 10).await), expected[..kept], "cut at {cut}");
        // Unacknowledged lines are sent again.
        let again = [lines(), vec![line(4, "d")]].concat();
        logs.append(&job(), FIRST, ("w", 1), again, NOW_MS + 1).await.unwrap();
        assert_eq!(messages(&read_after(&logs, &ALL, 0, 10).await), ["a", "b", "c", "d"], "cut at {cut}");
    }
    fs::write(&path, [&whole[..second], &[0xff; 100_000], b"\n", &whole[second..]].concat()).unwrap();
    let logs = JobLogs::new(dir.path(), 4 << 20);
    assert_eq!(messages(&read_after(&logs, &ALL, 0, 10).await), ["a", "b", "c"], "behind garbage");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lines_repeated_at_another_coordinator_are_stored_once() {
    let Some(url) = database() else { return };
    let kept = Kept::InDatabase(url);
    let both = [kept.open(4 << 20).await, kept.open(4 << 20).await];
    let job = job();
    for batch in 0..50 {
        let lines = || (1..=20).map(|index| line(batch * 20 + index, "x")).collect();
        // At once, and one after the other.
        let at_once = both.each_ref().map(|logs| logs.append(&job, FIRST, ("w", 9), lines(), NOW_MS));
        assert!(futures::future::join_all(at_once).await.iter().all(Result::is_ok));
        both[batch as usize % 2].append(&job, FIRST, ("w", 9), lines(), NOW_MS).await.unwrap();
    }
    let from_worker: Vec<Option<u64>> =
        read_after(both[0].as_ref(), &ALL, 0, 256).await.iter().map(|line| line.row.from_worker).collect();
    assert_eq!(from_worker, (1..=1000).map(Some).collect::<Vec<_>>());
    // The other one knows who may send the last lines of an attempt.
    both[0].append(&job, FIRST, ("w\0", 10), vec![line(1001, "x")], NOW_MS).await.unwrap();
    assert_eq!(both[1].holder(&job, FIRST, 10).await.unwrap().as_deref(), Some("w\0"));
    assert_eq!(both[1].holder(&job, FIRST, 9).await.unwrap(), None);
}

#[tokio::test]
async fn a_selective_reader_looks_at_a_bounded_number_of_lines() {
    let Some(url) = database() else { return };
    let logs = Kept::InDatabase(url).open(64 << 20).await;
    for batch in 0..40_u64 {
        let mut lines: Vec<NewLine> = (1..=250).map(|index| line(batch * 250 + index, "x")).collect();
        lines[249].severity = if batch == 39 { Severity::Error } else { Severity::Info };
        logs.append(&job(), FIRST, ("w", 1), lines, NOW_MS + batch).await.unwrap();
    }
    for task in [None, Some(FIRST.0)] {
        let wanted = Wanted { task, severity: Severity::Error, ..ALL };
        let (mut position, mut found) = (Position::default(), Vec::new());
        // 10 000 lines, 4096 a call.
        for more in [true, true, false] {
            let page = logs.read(&job(), &wanted, position, 256).await.unwrap();
            assert_eq!(page.more, more);
            (position, found) = (page.position, [found, page.lines].concat());
        }
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].row.number, logs.last(&job()).await.unwrap());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lines_of_a_worker_wait_until_a_killed_database_is_back() {
    let Some(mut server) = Server::start(Disk::Synced) else { return };
    let kept = Kept::InDatabase(server.database());
    let logs = kept.open(4 << 20).await;
    logs.append(&job(), FIRST, ("w", 1), vec![line(1, "a")], NOW_MS).await.unwrap();
    // Long enough for the database to write what no commit waited for.
    tokio::time::sleep(std::time::Duration::from_secs(2)).await;
    tokio::task::block_in_place(|| server.kill());
    let lines = || vec![line(1, "a"), line(2, "b")];
    let refused = logs.append(&job(), FIRST, ("w", 1), lines(), NOW_MS).await;
    assert!(matches!(refused, Err(LogError::Store(StoreError::Unavailable(_)))), "{refused:?}");
    let read = logs.read(&job(), &ALL, Position::default(), 10).await.map(|page| page.lines);
    assert!(matches!(read, Err(LogError::Store(StoreError::Unavailable(_)))), "{read:?}");
    tokio::task::block_in_place(|| server.resume());
    logs.append(&job(), FIRST, ("w", 1), lines(), NOW_MS).await.unwrap();
    assert_eq!(messages(&read_after(logs.as_ref(), &ALL, 0, 10).await), ["a", "b"]);
}
