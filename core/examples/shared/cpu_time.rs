//! CPU time of this process, which unlike wall time does not depend on other load of the machine.

/// CPU seconds of all living threads of this process. The resolution is a nanosecond if Linux counts by
/// thread, otherwise a hundredth of a second; 0 if neither is available.
pub fn cpu_seconds() -> f64 {
    by_thread().unwrap_or_else(in_ticks)
}

fn by_thread() -> Option<f64> {
    let mut nanoseconds = 0.0;
    for thread in std::fs::read_dir("/proc/self/task").ok()? {
        // A thread may end between listing and reading.
        let Ok(line) = std::fs::read_to_string(thread.ok()?.path().join("schedstat")) else { continue };
        nanoseconds += line.split_whitespace().next()?.parse::<f64>().ok()?;
    }
    (nanoseconds > 0.0).then_some(nanoseconds * 1e-9)
}

fn in_ticks() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    let ticks = |i: usize| fields.get(i).and_then(|field| field.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}
