//! Hostile input for everything that the coordinator reads from users, workers and files. `fathom_fuzz`
//! documents how it runs, how long, and how to replay a finding.

mod blobs;
mod calls;
mod files;
mod messages;

#[global_allocator]
static ALLOCATOR: fathom_fuzz::Counting = fathom_fuzz::Counting;
