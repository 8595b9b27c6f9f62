//@ import frame, ssim
// Adds the workgroup sums of one channel, in index order, to the log of losses. The first channel resets its
// entry.
//
// One thread, so that the order is the same in every run.

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> sums: array<f32>;
@group(0) @binding(2) var<storage, read_write> losses: array<f32>;

@compute @workgroup_size(1)
fn main() {
    let runs = (loss.size.y + RUN - 1u) / RUN;
    let groups = (runs * loss.size.x + 31u) / 32u;
    var total = 0.0;
    for (var i = 0u; i < veiled(groups, arrayLength(&sums)); i++) {
        total += sums[i];
    }
    var before = 0.0;
    if veiled(loss.channel, arrayLength(&losses)) > 0u {
        before = losses[loss.log_at];
    }
    losses[loss.log_at] = before + total * loss.scale;
}
