// Addresses of pictures in memory, which are valid until they are revoked.

export class Addresses {
    readonly #known = new Set<string>();
    #isEnded = false;

    of(content: Blob): string {
        if (this.#isEnded) {
            // An image with an address that is not valid any more would be reported as missing.
            throw new DOMException('ended', 'AbortError');
        }
        const address = URL.createObjectURL(content);
        this.#known.add(address);
        return address;
    }

    /** Revokes one address. A picture that is loaded stays on the page. */
    free(address: string): void {
        this.#known.delete(address);
        URL.revokeObjectURL(address);
    }

    /** Revokes all addresses. Later there are no others. */
    revoke(): void {
        this.#isEnded = true;
        this.#known.forEach((address) => URL.revokeObjectURL(address));
        this.#known.clear();
    }
}
