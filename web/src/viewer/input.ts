// Mouse, touch and keyboard on the picture, as turns and moves.

/** What the input asks for. */
export interface Asked {
    /** Radians to the left and upwards. */
    turn(yaw: number, pitch: number): void;
    /** Pixels by which the scene follows the pointer. */
    pan(x: number, y: number): void;
    /** Below 1: nearer. */
    zoom(factor: number): void;
    /** Steps to the right, upwards and forwards, in seconds of movement. */
    move(right: number, up: number, forward: number): void;
    /** A click or tap, CSS pixels from the top left of the element. */
    click(x: number, y: number): void;
    /** A double click or tap. */
    pick(x: number, y: number): void;
    /** As a double click in the middle of the picture. */
    pickMiddle(): void;
    reset(): void;
    /** To the next (1) or previous (-1) photograph. */
    photograph(step: number): void;
}

/** Radians by pixel of a drag. */
const TURN = 0.005;
/** Radians by second of an arrow key. */
const KEY_TURN = 1.2;
/** A pointer that moved less, in pixels, has clicked. */
const CLICK = 4;

const HELD = new Set([
    'KeyW', 'KeyA', 'KeyS', 'KeyD', 'KeyQ', 'KeyE',
    'ArrowUp', 'ArrowDown', 'ArrowLeft', 'ArrowRight',
    'Equal', 'Minus', 'NumpadAdd', 'NumpadSubtract',
]);

export class Input {
    readonly #element: HTMLElement;
    readonly #asked: Asked;
    readonly #stop = new AbortController();
    readonly #pointers = new Map<number, { x: number; y: number }>();
    readonly #keys = new Set<string>();
    #travelled = 0;
    #fast = false;
    #pans = false;

    constructor(element: HTMLElement, asked: Asked) {
        this.#element = element;
        this.#asked = asked;
        const signal = this.#stop.signal;
        element.addEventListener('pointerdown', (event) => this.#down(event), { signal });
        element.addEventListener('pointermove', (event) => this.#drag(event), { signal });
        element.addEventListener('pointerup', (event) => this.#up(event), { signal });
        element.addEventListener('pointercancel', (event) => this.#pointers.delete(event.pointerId), { signal });
        element.addEventListener('contextmenu', (event) => event.preventDefault(), { signal });
        element.addEventListener('wheel', (event) => this.#wheel(event), { signal, passive: false });
        element.addEventListener('dblclick', (event) => asked.pick(event.offsetX, event.offsetY), { signal });
        element.addEventListener('keydown', (event) => this.#key(event), { signal });
        element.addEventListener('keyup', (event) => this.#keys.delete(event.code), { signal });
        element.addEventListener('blur', () => this.#keys.clear(), { signal });
    }

    /** Whether a key is held, so that frames must go on. */
    get isHeld(): boolean {
        return this.#keys.size > 0;
    }

    /** Applies the held keys for a frame of `seconds`. */
    advance(seconds: number): void {
        if (this.#keys.size === 0) {
            return;
        }
        const axis = (plus: string[], minus: string[]): number => {
            const held = (codes: string[]): number => (codes.some((code) => this.#keys.has(code)) ? 1 : 0);
            return held(plus) - held(minus);
        };
        const step = seconds * (this.#fast ? 4 : 1);
        const [yaw, pitch] = [axis(['ArrowLeft'], ['ArrowRight']), axis(['ArrowUp'], ['ArrowDown'])];
        if (yaw !== 0 || pitch !== 0) {
            this.#asked.turn(yaw * KEY_TURN * seconds, pitch * KEY_TURN * seconds);
        }
        const move = [axis(['KeyD'], ['KeyA']), axis(['KeyE'], ['KeyQ']), axis(['KeyW'], ['KeyS'])] as const;
        if (move.some((value) => value !== 0)) {
            this.#asked.move(move[0] * step, move[1] * step, move[2] * step);
        }
        const zoom = axis(['Equal', 'NumpadAdd'], ['Minus', 'NumpadSubtract']);
        if (zoom !== 0) {
            this.#asked.zoom(Math.exp(-zoom * step));
        }
    }

    destroy(): void {
        this.#stop.abort();
    }

    #down(event: PointerEvent): void {
        this.#element.focus({ preventScroll: true });
        this.#element.setPointerCapture(event.pointerId);
        this.#pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        this.#pans = event.button === 1 || event.button === 2 || event.shiftKey;
        this.#travelled = this.#pointers.size > 1 ? CLICK : 0;
    }

    #drag(event: PointerEvent): void {
        const before = this.#pointers.get(event.pointerId);
        if (before === undefined) {
            return;
        }
        const now = { x: event.clientX, y: event.clientY };
        const [dx, dy] = [now.x - before.x, now.y - before.y];
        this.#travelled += Math.hypot(dx, dy);
        this.#pointers.set(event.pointerId, now);
        if (this.#pointers.size === 2) {
            // Two fingers: half of each finger's way is that of their middle.
            const other = [...this.#pointers].find(([id]) => id !== event.pointerId)?.[1] ?? now;
            const apart = (p: { x: number; y: number }): number => Math.hypot(p.x - other.x, p.y - other.y);
            this.#asked.pan(dx / 2, dy / 2);
            if (apart(before) > 1 && apart(now) > 1) {
                this.#asked.zoom(apart(before) / apart(now));
            }
        } else if (this.#pans) {
            this.#asked.pan(dx, dy);
        } else if (this.#travelled > CLICK) {
            this.#asked.turn(-dx * TURN, -dy * TURN);
        }
    }

    #up(event: PointerEvent): void {
        if (this.#pointers.delete(event.pointerId) && this.#travelled < CLICK && event.button === 0) {
            this.#asked.click(event.offsetX, event.offsetY);
        }
    }

    #wheel(event: WheelEvent): void {
        event.preventDefault();
        // Wheels that count lines or pages send small numbers.
        const pixels = event.deltaY * (event.deltaMode === 0 ? 1 : 30);
        this.#asked.zoom(Math.exp(Math.max(-240, Math.min(240, pixels)) * 0.0015));
    }

    #key(event: KeyboardEvent): void {
        if (event.ctrlKey || event.metaKey || event.altKey) {
            return;
        }
        this.#fast = event.shiftKey;
        if (HELD.has(event.code)) {
            event.preventDefault();
            this.#keys.add(event.code);
            // Even a key that is released before the next frame has an effect.
            this.advance(1 / 60);
        } else if (event.code === 'KeyR' || event.code === 'Home') {
            event.preventDefault();
            this.#asked.reset();
        } else if (event.code === 'KeyF') {
            event.preventDefault();
            this.#asked.pickMiddle();
        } else if (event.code === 'PageDown' || event.code === 'PageUp') {
            event.preventDefault();
            this.#asked.photograph(event.code === 'PageDown' ? 1 : -1);
        }
    }
}
