//! Numbers that a stored configuration could not represent.

use serde_json::Value;

/// Refuses numbers beyond the range of f32. They would become infinite, which JSON cannot represent, so a job
/// stored with one could not be read again.
pub(super) fn refuse_huge(value: &Value, name: &str) -> Result<(), String> {
    let inner = |key: &str| if name.is_empty() { key.to_owned() } else { format!("{name}.{key}") };
    match value {
        Value::Object(entries) => entries.iter().try_for_each(|(key, value)| refuse_huge(value, &inner(key))),
        Value::Array(values) => values.iter().try_for_each(|value| refuse_huge(value, name)),
        Value::Number(number) => match number.as_f64() {
            Some(number) if number.abs() > f64::from(f32::MAX) => {
                Err(format!("{name} is {number:e}; the limit for every setting is {:e}", f32::MAX))
            }
            _ => Ok(()),
        },
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use crate::config::JobConfig;

    #[test]
    fn numbers_beyond_f32_are_refused_and_the_largest_is_stored() {
        for (json, part) in [
            (r#"{"partition": {"extend_edge": 1e308}}"#, "partition.extend_edge is 1e308"),
            (r#"{"train": {"classic": {"gradient": -1e39}}}"#, "train.classic.gradient is -1e39"),
            (r#"{"train": {"sh_degree_at": [0.1, 1e200]}}"#, "train.sh_degree_at is 1e200"),
        ] {
            let refused = JobConfig::from_json(json).map_err(|error| error.to_string());
            assert!(refused.as_ref().is_err_and(|error| error.contains(part)), "{refused:?}");
        }
        let largest = JobConfig::from_json(r#"{"partition": {"extend_edge": 3.4028234e38}}"#);
        let stored = largest.and_then(|config| serde_json::to_string(&config));
        let read = stored.and_then(|stored| JobConfig::from_json(&stored));
        assert!(read.is_ok_and(|config| config.partition.extend_edge > 3.4e38));
    }
}
