use std::fs;
use std::sync::atomic::{AtomicBool, Ordering};

use super::*;
use crate::schedule::Stage;

const NOW_MS: u64 = 1_700_000_000_000;
const ALL: Wanted = Wanted { task: None, attempt: None, severity: Severity::Trace };
const FIRST: Attempt = (Stage::Partition.task_of(3), 1);

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
fn read_after(logs: &JobLogs, wanted: &Wanted, number: u64, limit: usize) -> Vec<KeptLine> {
    let mut position = Position::after(number);
    let mut all = Vec::new();
    loop {
        let (lines, more) = logs.read(&job(), wanted, &mut position, limit).unwrap();
        assert!(lines.len() <= limit);
        all.extend(lines);
        if !more {
            return all;
        }
    }
}

fn messages(lines: &[KeptLine]) -> Vec<&str> {
    lines.iter().map(|line| line.row.message.as_str()).collect()
}

fn bytes_of(dir: &Path) -> u64 {
    fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().metadata().unwrap().len()).sum()
}

#[test]
fn lines_arrive_in_order_and_once_wherever_a_reader_resumes() {
    let dir = tempfile::tempdir().unwrap();
    let logs = JobLogs::new(dir.path(), 4 << 20);
    let attempts = [FIRST, (Stage::Merge.task(), 1), (Stage::Partition.task_of(3), 2)];
    for index in 0..200_u64 {
        let attempt = attempts[(index * index % 7 % 3) as usize];
        let mut new = line(index + 1, &index.to_string());
        new.severity = if index % 10 == 0 { Severity::Warn } else { Severity::Info };
        logs.append(&job(), attempt, ("w", 1), vec![new], NOW_MS + index / 20).unwrap();
    }
    let all = read_after(&logs, &ALL, 0, 7);
    let expected: Vec<String> = (0..200).map(|index| index.to_string()).collect();
    assert_eq!(messages(&all), expected);
    assert!(all.windows(2).all(|pair| pair[0].row.number < pair[1].row.number));
    for from in [0, 1, 57, 198, 199] {
        let after = all[from].row.number;
        assert_eq!(read_after(&logs, &ALL, after, 50), all[from + 1..]);
    }
    let warnings = Wanted { severity: Severity::Warn, ..ALL };
    assert_eq!(read_after(&logs, &warnings, 0, 3).len(), 20);
    let of_second = Wanted { task: Some(Stage::Partition.task_of(3)), attempt: Some(2), ..ALL };
    let kept: Vec<KeptLine> = all.iter().filter(|line| line.attempt == 2).cloned().collect();
    assert!(!kept.is_empty());
    assert_eq!(read_after(&logs, &of_second, 0, 10), kept);
}

#[test]
fn a_repeated_line_is_stored_once_even_across_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let mut before = 0;
    for run in 0..3 {
        // A wall clock that is set back between two runs.
        let now_ms = NOW_MS - run * 1000;
        let logs = JobLogs::new(dir.path(), 4 << 20);
        for _ in 0..2 {
            let lines = (1..=2 * (run + 1)).map(|number| line(number, &number.to_string())).collect();
            logs.append(&job(), FIRST, ("w", 1), lines, now_ms).unwrap();
        }
        let own = NewLine { from_worker: None, ..line(0, "of the coordinator") };
        logs.append(&job(), FIRST, ("coordinator", 0), vec![own], now_ms).unwrap();
        let new = read_after(&logs, &ALL, before, 100);
        let [first, second] = [2 * run + 1, 2 * run + 2].map(|number| number.to_string());
        assert_eq!(messages(&new), [first.as_str(), &second, "of the coordinator"]);
        before = new.last().unwrap().row.number;
        assert_eq!(logs.jobs().unwrap(), [job()]);
    }
}

#[test]
fn only_a_line_that_a_crash_truncated_is_skipped() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(job().as_str()).join("partition-0003.1.0");
    let logs = JobLogs::new(dir.path(), 4 << 20);
    logs.append(&job(), FIRST, ("w", 1), vec![line(1, "a"), line(2, "b"), line(3, "c")], NOW_MS).unwrap();
    let whole = fs::read(&path).unwrap();
    let second = whole.iter().position(|&b| b == b'\n').unwrap() + 1;
    let third = second + whole[second..].iter().position(|&b| b == b'\n').unwrap() + 1;
    for cut in [1, second - 1, second, second + 5, third - 1, third, third + 1, whole.len() - 1] {
        fs::write(&path, &whole[..cut]).unwrap();
        let logs = JobLogs::new(dir.path(), 4 << 20);
        let kept = [second, third, whole.len()].iter().filter(|&&end| end <= cut).count();
        let expected = ["a", "b", "c"];
        assert_eq!(messages(&read_after(&logs, &ALL, 0, 10)), expected[..kept], "cut at {cut}");
        // Unacknowledged lines are sent again.
        let again = vec![line(1, "a"), line(2, "b"), line(3, "c"), line(4, "d")];
        logs.append(&job(), FIRST, ("w", 1), again, NOW_MS + 1).unwrap();
        assert_eq!(messages(&read_after(&logs, &ALL, 0, 10)), ["a", "b", "c", "d"], "cut at {cut}");
    }
    fs::write(&path, [&whole[..second], &[0xff; 100_000], b"\n", &whole[second..]].concat()).unwrap();
    let logs = JobLogs::new(dir.path(), 4 << 20);
    assert_eq!(messages(&read_after(&logs, &ALL, 0, 10)), ["a", "b", "c"], "behind garbage");
}

#[test]
fn a_long_attempt_keeps_its_first_and_latest_lines() {
    const BOUND: u64 = 64 << 10;
    let dir = tempfile::tempdir().unwrap();
    let logs = JobLogs::new(dir.path(), BOUND);
    let mut follower = Position::default();
    let mut followed = Vec::new();
    for batch in 0..100_u64 {
        let lines = (1..=50).map(|index| line(batch * 50 + index, &format!("line {}", batch * 50 + index)));
        logs.append(&job(), FIRST, ("w", 1), lines.collect(), NOW_MS + batch).unwrap();
        followed.extend(logs.read(&job(), &ALL, &mut follower, usize::MAX).unwrap().0);
    }
    let folder = dir.path().join(job().as_str());
    assert!(bytes_of(&folder) <= BOUND, "{} bytes", bytes_of(&folder));
    let expected: Vec<String> = (1..=5000).map(|number| format!("line {number}")).collect();
    assert_eq!(messages(&followed), expected, "a reader that keeps up misses nothing");

    for logs in [logs, JobLogs::new(dir.path(), BOUND)] {
        let lines = read_after(&logs, &ALL, 0, 64);
        let all = messages(&lines);
        assert_eq!((all[0], *all.last().unwrap()), ("line 1", "line 5000"));
        let cuts: Vec<usize> = (0..all.len()).filter(|&index| all[index].contains("removed here")).collect();
        assert_eq!(cuts.len(), 1, "{cuts:?}");
        assert!(all.len() > 200, "{} lines are left", all.len());
        let after_cut = lines[cuts[0]].row.number;
        assert_eq!(read_after(&logs, &ALL, after_cut, 64), lines[cuts[0] + 1..]);
        assert!(lines.windows(2).all(|pair| pair[0].row.number < pair[1].row.number));
    }
}

#[test]
fn old_attempts_of_a_task_and_deleted_jobs_leave_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let logs = JobLogs::new(dir.path(), 4 << 20);
    for attempt in 1..=40 {
        for task in [Stage::Global.task(), Stage::Partition.task_of(0)] {
            logs.append(&job(), (task, attempt), ("w", u64::from(attempt)), vec![line(1, "x")], NOW_MS)
                .unwrap();
        }
    }
    let left = read_after(&logs, &ALL, 0, 1000);
    assert_eq!(left.len() as u32, 2 * ATTEMPTS_KEPT);
    assert!(left.iter().all(|line| line.attempt > 40 - ATTEMPTS_KEPT));
    let holder = |fence| logs.holder(&job(), (Stage::Global.task(), 40), fence);
    assert_eq!((holder(40).as_deref(), holder(39)), (Some("w"), None));
    logs.remove(&job()).unwrap();
    assert_eq!(read_after(&logs, &ALL, 0, 10), []);
    assert!(!dir.path().join(job().as_str()).exists());
    logs.remove(&job()).unwrap();
}

#[test]
fn a_reader_beside_many_writers_sees_every_line_once_in_order() {
    let dir = tempfile::tempdir().unwrap();
    let logs = JobLogs::new(dir.path(), 64 << 20);
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let writers = [0, 1, 2, 3].map(|index| {
            let logs = &logs;
            scope.spawn(move || {
                for number in 1..=500 {
                    let attempt = (Stage::Partition.task_of(index), 1);
                    logs.append(&job(), attempt, ("w", 1), vec![line(number, "x")], NOW_MS + number).unwrap();
                }
            })
        });
        let reader = scope.spawn(|| {
            let (mut position, mut seen) = (Position::default(), Vec::new());
            loop {
                let last_time = done.load(Ordering::SeqCst);
                let (lines, more) = logs.read(&job(), &ALL, &mut position, 17).unwrap();
                seen.extend(lines);
                if !more && last_time {
                    return seen;
                }
            }
        });
        writers.into_iter().for_each(|writer| writer.join().unwrap());
        done.store(true, Ordering::SeqCst);
        let seen = reader.join().unwrap();
        assert_eq!(seen.len(), 2000);
        assert!(seen.windows(2).all(|pair| pair[0].row.number < pair[1].row.number));
    });
}
