// How both stages of the sort visit the keys of a chunk on adapters with subgroups. There are 256 threads; a
// subgroup takes consecutive keys, as many at a time as it has lanes. Needs counters.wgsl, subgroups.wgsl and
// the names which, keys.

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
    // Lanes whose key has the same digit; empty if there is no key.
    peers: vec4<u32>,
    // Whether there is a key, and whether this is the first lane with its digit.
    valid: bool,
    first: bool,
}

// All threads must reach this call.
fn key_of(chunk: u32, round: u32, n: u32, s: Subgroup) -> Key {
    let at = chunk * SORT_CHUNK + s.index * (SORT_CHUNK / s.count) + round * s.size + s.lane;
    // A chunk after the last begins after the last key.
    let valid = at < n;
    var key = 0u;
    if valid {
        key = keys[at];
    }
    let digit = (key >> which.y) & (SORT_BINS - 1u);
    let peers = same_digit(digit, valid);
    return Key(at, key, s.index * SORT_BINS + digit, peers, valid, valid && first_lane(peers) == s.lane);
}

// The first lane with a digit counts for all lanes with that digit: no atomics.
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
        // A workgroup barrier, because on Vulkan a subgroup barrier does not order workgroup memory.
        workgroupBarrier();
    }
}
