//! Hostile input for everything that the coordinator reads of users, workers and files: `fathom_fuzz` says
//! how it runs, how long, and how a finding is replayed.

mod blobs;
mod calls;
mod files;
mod messages;

#[global_allocator]
static ALLOCATOR: fathom_fuzz::Counting = fathom_fuzz::Counting;
