//! `fathom doctor`: lists the GPUs and reports missing drivers.

use clap::Args;
use fathom_core::gpu::{AdapterSummary, adapters};
use serde_json::json;

use crate::error::{CliError, Result};
use crate::output;

/// Arguments of `fathom doctor`.
#[derive(Args, Debug)]
pub struct DoctorArgs {
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: DoctorArgs) -> Result<()> {
    let adapters = adapters();
    let advice = advice(&adapters);
    if args.json {
        let list = adapters.iter().enumerate().map(|(index, adapter)| {
            json!({
                "index": index,
                "name": adapter.name,
                "driver": adapter.driver,
                "backend": adapter.backend,
                "is_cpu": adapter.is_cpu,
                "max_binding_bytes": adapter.max_binding_bytes,
            })
        });
        output::json(&json!({
            "version": env!("CARGO_PKG_VERSION"),
            "adapters": list.collect::<Vec<_>>(),
            "cpus": std::thread::available_parallelism().map_or(1, |n| n.get()),
            "advice": advice,
        }))?;
    } else {
        for (index, adapter) in adapters.iter().enumerate() {
            output::line(format!(
                "adapter {index}: {} ({}, {}){}, bindings up to {}",
                adapter.name,
                adapter.backend,
                adapter.driver,
                if adapter.is_cpu { ", runs on the CPU" } else { "" },
                output::bytes(adapter.max_binding_bytes)
            ));
        }
        for sentence in &advice {
            output::line(sentence);
        }
    }
    if adapters.is_empty() {
        return Err(CliError::Message(
            "no adapter was found, so nothing can be trained or rendered".to_owned(),
        ));
    }
    Ok(())
}

fn advice(adapters: &[AdapterSummary]) -> Vec<String> {
    let mut advice = Vec::new();
    if adapters.is_empty() && cfg!(target_os = "linux") {
        advice.push(
            "no Vulkan driver was found; on Debian and Ubuntu: apt-get install libvulkan1 mesa-vulkan-drivers \
             (for AMD, Intel, and the CPU), or NVIDIA's driver package for its GPUs. In a container, NVIDIA's driver \
             needs NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility"
                .to_owned(),
        );
    } else if adapters.is_empty() {
        advice.push("no GPU driver was found; update the system's graphics driver".to_owned());
    } else if adapters.iter().all(|adapter| adapter.is_cpu) {
        advice.push(
            "no GPU was found: --allow-cpu trains on the CPU, which is slow; if this machine has a GPU, its \
             Vulkan driver is missing"
                .to_owned(),
        );
    } else {
        advice.push("ready: the first adapter that does not run on the CPU is the default".to_owned());
    }
    advice
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(is_cpu: bool) -> AdapterSummary {
        let text = || "any".to_owned();
        AdapterSummary {
            name: text(),
            driver: text(),
            backend: text(),
            is_cpu,
            max_binding_bytes: 1 << 27,
            pci_bus_id: text(),
        }
    }

    #[test]
    fn advice_for_a_cpu_only_machine_names_the_flag() {
        assert!(advice(&[adapter(true)])[0].contains("--allow-cpu"));
        assert!(advice(&[adapter(true), adapter(false)])[0].contains("ready"));
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn advice_without_adapters_names_the_packages() {
        assert!(advice(&[])[0].contains("mesa-vulkan-drivers"));
    }
}
