//! Selects the GPUs that a worker uses.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use fathom_core::CoreError;
use fathom_core::gpu::{AdapterSummary, GpuOptions, adapters, numbered};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::execute::{CoreExecutor, Executor};
use crate::{WorkerConfig, WorkerError};

/// The GPUs that a worker uses, each for one task at a time.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Gpus {
    /// The first real one.
    #[default]
    First,
    /// These adapters, by their numbers in `fathom doctor`.
    These(Vec<usize>),
    /// Every real GPU, each once.
    All,
}

/// A GPU as named in a setting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GpuName {
    /// By its number.
    Number(usize),
    /// All GPUs.
    All,
}

impl FromStr for GpuName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "all" => Ok(Self::All),
            _ => text
                .parse()
                .map(Self::Number)
                .map_err(|_| "use a number of `fathom doctor`, or all".to_owned()),
        }
    }
}

impl fmt::Display for GpuName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number}"),
            Self::All => write!(f, "all"),
        }
    }
}

impl Serialize for GpuName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Number(number) => serializer.serialize_u64(*number as u64),
            Self::All => serializer.serialize_str("all"),
        }
    }
}

/// In a file: a number, "all", or several in brackets; an empty list is the first real GPU.
#[derive(Deserialize)]
#[serde(untagged, expecting = "for gpu use a number, several in brackets, or \"all\"")]
enum Written {
    Number(usize),
    Word(String),
    Several(Vec<Written>),
}

impl Written {
    fn names(self) -> Result<Vec<GpuName>, String> {
        match self {
            Self::Number(number) => Ok(vec![GpuName::Number(number)]),
            Self::Word(word) => word.parse().map(|name| vec![name]),
            Self::Several(several) => several
                .into_iter()
                .map(Self::names)
                .collect::<Result<Vec<_>, _>>()
                .map(|names| names.concat()),
        }
    }
}

impl<'de> Deserialize<'de> for Gpus {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let written = Written::deserialize(deserializer)?;
        written.names().and_then(|names| Self::named(&names)).map_err(D::Error::custom)
    }
}

impl Serialize for Gpus {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::First => serializer.collect_seq([0_usize; 0]),
            Self::These(numbers) => serializer.collect_seq(numbers),
            Self::All => serializer.serialize_str("all"),
        }
    }
}

impl Gpus {
    /// The GPUs selected by these names.
    ///
    /// # Errors
    /// When "all" is combined with other names.
    pub fn named(names: &[GpuName]) -> Result<Self, String> {
        let number = |name: &GpuName| match name {
            GpuName::Number(number) => Some(*number),
            GpuName::All => None,
        };
        match names {
            [] => Ok(Self::First),
            [GpuName::All] => Ok(Self::All),
            names => names.iter().map(number).collect::<Option<_>>().map(Self::These).ok_or_else(|| {
                let names: Vec<String> = names.iter().map(GpuName::to_string).collect();
                format!("the GPUs {}: use either numbers or all", names.join(", "))
            }),
        }
    }

    /// The numbers of the selected adapters among `there`; `None` leaves the choice to the trainer.
    fn among(&self, there: &[AdapterSummary]) -> Result<Vec<Option<usize>>, CoreError> {
        let refuse = |fault: String| {
            let there = if there.is_empty() { "no adapters".to_owned() } else { numbered(there) };
            Err(CoreError::NoAdapter(format!("{fault}; this machine has {there}")))
        };
        match self {
            Self::First => Ok(vec![None]),
            Self::These(numbers) => {
                for (place, number) in numbers.iter().enumerate() {
                    let Some(adapter) = there.get(*number) else {
                        return refuse(format!("there is no adapter {number}"));
                    };
                    for earlier in &numbers[..place] {
                        if earlier == number {
                            return refuse(format!("adapter {number} is named twice"));
                        }
                        if there[*earlier].is_same_gpu(adapter) {
                            return refuse(format!("adapters {earlier} and {number} are the same GPU"));
                        }
                    }
                }
                Ok(numbers.iter().copied().map(Some).collect())
            }
            Self::All => {
                let mut real: Vec<usize> = Vec::new();
                for (number, adapter) in there.iter().enumerate().filter(|(_, adapter)| !adapter.is_cpu) {
                    if !real.iter().any(|&earlier| there[earlier].is_same_gpu(adapter)) {
                        real.push(number);
                    }
                }
                // Without a real GPU only the CPU adapter is left; the trainer uses it if allowed.
                Ok(if real.is_empty() { vec![None] } else { real.into_iter().map(Some).collect() })
            }
        }
    }
}

/// One GPU of a worker, with its executor.
#[derive(Clone)]
pub struct OnGpu {
    /// Number of the adapter.
    pub number: usize,
    /// Executes the tasks.
    pub executor: Arc<dyn Executor>,
}

/// Opens the GPUs of `config`; waits for their drivers. With "all", GPUs that cannot be opened are skipped.
///
/// # Errors
/// When a named GPU is missing, named twice or cannot be opened, and when none can be opened.
pub fn open(config: &WorkerConfig) -> Result<Vec<OnGpu>, WorkerError> {
    // Listing adapters opens every driver, and the default needs no list.
    let there = if config.gpus == Gpus::First { Vec::new() } else { adapters() };
    let meant = config.gpus.among(&there)?;
    let image_cache_bytes = config.image_cache_bytes / meant.len() as u64;
    let may_lack_some = config.gpus == Gpus::All && meant.len() > 1;
    let (mut opened, mut failed) = (Vec::new(), None);
    for index in meant {
        let options = GpuOptions {
            index,
            allow_cpu: config.allow_cpu,
            memory_limit: config.gpu_memory_limit,
            ..GpuOptions::default()
        };
        let number = index.unwrap_or(0);
        match CoreExecutor::new(options, image_cache_bytes) {
            Ok(executor) => opened.push(OnGpu { number, executor: Arc::new(executor) }),
            Err(error) if may_lack_some => {
                tracing::warn!(gpu = number, %error, "this GPU cannot be used; using the others");
                failed = Some(error);
            }
            Err(error) => return Err(error.into()),
        }
    }
    match failed {
        Some(error) if opened.is_empty() => Err(error.into()),
        _ => Ok(opened),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(name: &str, backend: &str, pci_bus_id: &str) -> AdapterSummary {
        AdapterSummary {
            name: name.into(),
            driver: "driver".into(),
            backend: backend.into(),
            is_cpu: name == "llvmpipe",
            max_binding_bytes: 1 << 27,
            pci_bus_id: pci_bus_id.into(),
        }
    }

    fn refusal(numbers: &[usize], there: &[AdapterSummary]) -> String {
        Gpus::These(numbers.to_vec()).among(there).unwrap_err().to_string()
    }

    #[test]
    fn missing_or_repeated_adapters_are_refused_with_a_list() {
        let there = [adapter("H200", "vulkan", "0000:01:00.0"), adapter("llvmpipe", "vulkan", "")];
        let list = "this machine has 0: H200 (vulkan), 1: llvmpipe (vulkan, on the CPU)";
        assert_eq!(refusal(&[0, 7], &there), format!("there is no adapter 7; {list}"));
        assert_eq!(refusal(&[1, 0, 1], &there), format!("adapter 1 is named twice; {list}"));
        assert_eq!(refusal(&[0], &[]), "there is no adapter 0; this machine has no adapters");
        assert_eq!(Gpus::These(vec![1, 0]).among(&there).unwrap(), [Some(1), Some(0)]);
    }

    #[test]
    fn a_gpu_that_two_backends_list_is_one_and_equal_gpus_are_two() {
        let there = [
            adapter("H200", "vulkan", "0000:01:00.0"),
            adapter("H200", "vulkan", "0000:02:00.0"),
            adapter("H200", "dx12", "0000:01:00.0"),
            adapter("M3", "metal", ""),
            adapter("M3", "vulkan", ""),
            adapter("M3", "metal", ""),
            adapter("llvmpipe", "vulkan", ""),
        ];
        assert_eq!(Gpus::All.among(&there).unwrap(), [Some(0), Some(1), Some(3), Some(5)]);
        assert!(refusal(&[1, 0, 2], &there).starts_with("adapters 0 and 2 are the same GPU; "));
        assert_eq!(Gpus::All.among(&there[6..]).unwrap(), [None], "of a machine without a GPU");
    }

    #[test]
    fn names_are_numbers_or_all_by_itself() {
        let named = |text: &str| -> Result<Gpus, String> {
            let names: Result<Vec<GpuName>, String> = text.split_whitespace().map(str::parse).collect();
            Gpus::named(&names?)
        };
        assert_eq!(named(""), Ok(Gpus::First));
        assert_eq!(named("all"), Ok(Gpus::All));
        assert_eq!(named("2 0"), Ok(Gpus::These(vec![2, 0])));
        assert_eq!(named("0 all"), Err("the GPUs 0, all: use either numbers or all".into()));
        assert_eq!(named("-1"), Err("use a number of `fathom doctor`, or all".into()));
    }
}
