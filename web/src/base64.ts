// Base64 without line breaks, in steps: a whole model as one text of characters would need the memory twice.

/** Characters that are decoded at a time; a multiple of 4. */
const STEP = 1 << 20;

/** The bytes of a text. Throws where it is not base64. */
export function decodeBase64(text: string): Uint8Array<ArrayBuffer> {
    const padding = text.endsWith('==') ? 2 : text.endsWith('=') ? 1 : 0;
    const bytes = new Uint8Array((text.length / 4) * 3 - padding);
    for (let from = 0, to = 0; from < text.length; from += STEP) {
        const part = atob(text.slice(from, from + STEP));
        for (let i = 0; i < part.length; i++) {
            bytes[to++] = part.charCodeAt(i);
        }
    }
    return bytes;
}
