// Addresses of pictures in memory, which are valid until they are revoked.

export class Addresses {
    readonly #known: string[] = [];
    #isEnded = false;

    of(content: Blob): string {
        if (this.#isEnded) {
            // An image with an address that is not valid any more would be reported as missing.
            throw new DOMException('ended', 'AbortError');
        }
        const address = URL.createObjectURL(content);
        this.#known.push(address);
        return address;
    }

    /** Revokes all addresses. Later there are no others. */
    revoke(): void {
        this.#isEnded = true;
        this.#known.splice(0).forEach((address) => URL.revokeObjectURL(address));
    }
}
