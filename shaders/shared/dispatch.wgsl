// The one place that folds a count into a dispatch of two dimensions, with at most 32768 groups in x. Needs
// counters.wgsl and the name args.

fn put(slot: u32, groups: u32) {
    let x = min(groups, 32768u);
    args[3u * slot] = x;
    args[3u * slot + 1u] = select(0u, groups_for(groups, max(x, 1u)), groups > 0u);
    args[3u * slot + 2u] = select(0u, 1u, groups > 0u);
}
