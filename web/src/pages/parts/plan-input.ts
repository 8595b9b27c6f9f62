// Pointer, wheel and keys on the map of a plan.
//
// A page scrolls under the pointer as usual. The wheel zooms only while the map has the focus or Ctrl is held,
// and one finger moves the map only when it is zoomed.

export interface MapActions {
    move(left: number, top: number): void;
    leave(): void;
    press(left: number, top: number): void;
    pan(dx: number, dy: number): void;
    zoom(factor: number, left?: number, top?: number): void;
    /** Chooses the next partition: 1 or -1 along x or z. */
    step(dx: number, dz: number): void;
    whole(): void;
    clear(): void;
    isZoomed(): boolean;
}

/** A pointer that moved by less is a press, pixels. */
const SLACK = 5;
const ARROWS: Readonly<Record<string, readonly [number, number]>> = {
    ArrowLeft: [-1, 0],
    ArrowRight: [1, 0],
    ArrowUp: [0, 1],
    ArrowDown: [0, -1],
};

/** Listens; returns how to stop. */
export function watchMap(canvas: HTMLCanvasElement, actions: MapActions): () => void {
    const pointers = new Map<number, { x: number; y: number }>();
    let moved = 0;
    const placeOf = (event: MouseEvent): { x: number; y: number } => {
        const box = canvas.getBoundingClientRect();
        return { x: event.clientX - box.left, y: event.clientY - box.top };
    };
    const listeners: { [K in keyof HTMLElementEventMap]?: (event: HTMLElementEventMap[K]) => void } = {
        pointerdown(event) {
            if (event.button === 0) {
                pointers.set(event.pointerId, placeOf(event));
                moved = pointers.size === 1 ? 0 : Infinity;
                canvas.setPointerCapture(event.pointerId);
            }
        },
        pointermove(event) {
            const to = placeOf(event);
            const from = pointers.get(event.pointerId);
            if (from === undefined) {
                actions.move(to.x, to.y);
                return;
            }
            if (pointers.size === 2) {
                const other = [...pointers].find(([id]) => id !== event.pointerId)![1];
                const before = Math.hypot(from.x - other.x, from.y - other.y);
                const after = Math.hypot(to.x - other.x, to.y - other.y);
                actions.zoom(after / Math.max(1, before), (to.x + other.x) / 2, (to.y + other.y) / 2);
            } else {
                moved += Math.hypot(to.x - from.x, to.y - from.y);
                if (moved > SLACK && actions.isZoomed()) {
                    actions.pan(to.x - from.x, to.y - from.y);
                }
            }
            pointers.set(event.pointerId, to);
        },
        pointerup(event) {
            if (pointers.delete(event.pointerId) && moved <= SLACK) {
                const { x, y } = placeOf(event);
                actions.press(x, y);
            }
        },
        pointercancel(event) {
            pointers.delete(event.pointerId);
        },
        pointerleave(event) {
            if (event.pointerType === 'mouse') {
                actions.leave();
            }
        },
        wheel(event) {
            if (event.ctrlKey || event.metaKey || document.activeElement === canvas) {
                event.preventDefault();
                const { x, y } = placeOf(event);
                const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 20 : 1;
                actions.zoom(Math.exp(-0.0025 * lines * event.deltaY), x, y);
            }
        },
        keydown(event) {
            const arrow = ARROWS[event.key];
            if (event.ctrlKey || event.metaKey || event.altKey) {
                return;
            }
            if (arrow !== undefined) {
                actions.step(...(arrow as [number, number]));
            } else if (event.key === '+' || event.key === '=') {
                actions.zoom(1.5);
            } else if (event.key === '-') {
                actions.zoom(1 / 1.5);
            } else if (event.key === '0') {
                actions.whole();
            } else if (event.key === 'Escape') {
                actions.clear();
            } else {
                return;
            }
            event.preventDefault();
        },
    };
    const entries = Object.entries(listeners) as [string, EventListener][];
    // The wheel must be able to stop the page from scrolling.
    entries.forEach(([name, listener]) => canvas.addEventListener(name, listener, { passive: false }));
    return () => entries.forEach(([name, listener]) => canvas.removeEventListener(name, listener));
}
