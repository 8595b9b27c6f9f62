//! The gRPC contracts of Fathom. The `.proto` files are the documentation: their service comments describe
//! the life cycles, and every field has a comment, which `cargo doc` shows here. Clients connect with
//! [`dial`], and use the bucket of a coordinator with [`direct`].
#![allow(clippy::doc_lazy_continuation, reason = "prost indents the second line of a list item by one space")]

pub mod dial;
pub mod direct;

/// Users: jobs and blobs.
pub mod v1 {
    tonic::include_proto!("fathom.v1");
}

/// Operators.
pub mod admin {
    /// Version 1.
    pub mod v1 {
        tonic::include_proto!("fathom.admin.v1");
    }
}

/// Workers.
pub mod worker {
    /// Version 1 of the worker protocol.
    pub mod v1 {
        tonic::include_proto!("fathom.worker.v1");

        impl CommonSpec {
            /// Iteration of the run at which the task ends.
            pub fn end_iteration(&self) -> u32 {
                if self.until_iteration == 0 {
                    self.iterations
                } else {
                    self.until_iteration.min(self.iterations)
                }
            }

            /// Iterations of the run that are this task's.
            pub fn own_iterations(&self) -> u32 {
                self.end_iteration().saturating_sub(self.from_iteration)
            }
        }
    }
}

/// KEDA's interface of external scalers.
pub mod keda {
    tonic::include_proto!("externalscaler");
}

/// All messages and services as an encoded `FileDescriptorSet`, for reflection and compatibility tests.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// Version of the worker protocol that this build speaks.
pub const WORKER_PROTOCOL_VERSION: u32 = 3;

/// The name of a stage in metrics, logs and on the command line, as in names of tasks.
pub fn stage_name(stage: v1::Stage) -> String {
    stage.as_str_name().trim_start_matches("STAGE_").to_ascii_lowercase()
}

/// Largest piece of a blob in one message.
pub const CHUNK_BYTES: usize = 1 << 20;

/// Domain of every `google.rpc.ErrorInfo` that Fathom sends.
pub const ERROR_DOMAIN: &str = "fathom";
