// How the threads of a tile share splats when they are the eight lanes of one vector: by broadcasts. For CPU
// adapters with subgroups of eight (lavapipe). On such an adapter a load from memory costs one instruction
// per lane and number, and a broadcast from a known lane costs one for all lanes. Measured against
// exchange_workgroup.wgsl: `kernels` in bench/history.jsonl.

const BATCH: u32 = 8u;

var<private> mine: Splat;

fn share_splats(lane: u32, first: u32, last: u32) {
    mine = Splat(vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0));
    if first + lane < last {
        let at = 3u * visible_from_slot[slots[first + lane]];
        mine = Splat(projected[at], projected[at + 1u], projected[at + 2u]);
    }
}

fn shared_splat(i: u32) -> Splat {
    return Splat(from_lane(mine.a, i), from_lane(mine.b, i), from_lane(mine.c, i));
}
