// BLAKE3 of a file, read in pieces, so that memory does not grow with its length.

import { blake3 } from '@noble/hashes/blake3.js';
import { bytesToHex } from '@noble/hashes/utils.js';

/** 64 lower-case hex digits. */
export function digestOfBytes(bytes: Uint8Array): string {
    return bytesToHex(blake3(bytes));
}

/** As `digestOfBytes`. Rejects if the file gives another number of bytes than it should: it has changed. */
export async function digestOfFile(file: Blob, onBytes: (more: number) => void): Promise<string> {
    const hash = blake3.create();
    const reader = file.stream().getReader();
    let bytes = 0;
    for (let read = await reader.read(); !read.done; read = await reader.read()) {
        hash.update(read.value);
        bytes += read.value.length;
        onBytes(read.value.length);
    }
    if (bytes !== file.size) {
        throw new DOMException(`has ${bytes} bytes instead of ${file.size}`, 'NotReadableError');
    }
    return bytesToHex(hash.digest());
}
