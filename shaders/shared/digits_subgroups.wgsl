// How both stages of the sort meet the keys of a chunk where there are subgroups: 256 threads, and a subgroup
// takes consecutive keys, as many at a time as it has lanes. Needs counters.wgsl, subgroups.wgsl and the
// names which, keys.

// [32 subgroups at most][64 digits]: how many keys of the digit a subgroup has.
var<workgroup> sh_digits: array<u32, 2048>;

const ROUNDS: u32 = SORT_CHUNK / 256u;

struct Subgroup {
    index: u32,
    count: u32,
    size: u32,
    lane: u32,
}

struct Key {
    at: u32,
    key: u32,
    // Entry of sh_digits.
    slot: u32,
    // Lanes with a key of the same digit; none where there is no key.
    peers: vec4<u32>,
    // Whether there is a key, and whether this lane is the first that has one of the digit.
    valid: bool,
    first: bool,
}

// All threads must be here.
fn key_of(chunk: u32, round: u32, n: u32, s: Subgroup) -> Key {
    let at = chunk * SORT_CHUNK + s.index * (SORT_CHUNK / s.count) + round * s.size + s.lane;
    // A chunk behind the last begins behind the last key.
    let valid = at < n;
    var key = 0u;
    if valid {
        key = keys[at];
    }
    let digit = (key >> which.y) & (SORT_BINS - 1u);
    let peers = same_digit(digit, valid);
    return Key(at, key, s.index * SORT_BINS + digit, peers, valid, valid && first_lane(peers) == s.lane);
}

// The first of the lanes with one digit counts for all: no atomics.
fn count_digits(thread: u32, chunk: u32, n: u32, s: Subgroup) {
    for (var i = thread; i < 2048u; i += 256u) {
        sh_digits[i] = 0u;
    }
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS; round++) {
        let k = key_of(chunk, round, n, s);
        if k.first {
            sh_digits[k.slot] += ones(k.peers);
        }
        // Of a workgroup: on Vulkan a barrier of a subgroup does not order workgroup memory.
        workgroupBarrier();
    }
}
