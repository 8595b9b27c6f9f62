// What tests with pages of a service do again and again.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { join } from 'node:path';
import type { Browser, BrowserContextOptions, Page } from 'playwright-core';

import { newPage } from './browser.ts';

const AXE = readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');

const PHONE = { width: 390, height: 800 };
/** A folder for pictures of what a test saw, for people. */
const SHOTS = process.env['SHOTS'] ?? '';

export interface Opened {
    readonly page: Page;
    /** What the console and the policy complain about. */
    readonly complaints: string[];
}

export const sleep = (ms: number): Promise<void> => new Promise((done) => setTimeout(done, ms));

export async function until(what: string, isSo: () => Promise<boolean>, seconds = 60): Promise<void> {
    const end = Date.now() + seconds * 1000;
    while (!(await isSo())) {
        assert.ok(Date.now() < end, `${what} within ${seconds} s`);
        await sleep(150);
    }
}

/** Opens a page as its user would find it: signed in, with the token in the session of the tab. */
export async function openAs(browser: Browser, address: string, token = '', options: BrowserContextOptions = {}): Promise<Opened> {
    const opened = await newPage(browser, { viewport: { width: 1200, height: 850 }, ...options });
    if (token !== '') {
        await opened.page.addInitScript((value) => {
            // Only once: after a sign-out it must not come back.
            if (sessionStorage.getItem('test.set') === null) {
                sessionStorage.setItem('test.set', 'yes');
                sessionStorage.setItem('fathom.token', value);
            }
        }, token);
    }
    await opened.page.goto(address);
    return opened;
}

/** The rules of axe that look at colours. */
const COLOUR_RULES = ['color-contrast', 'link-in-text-block'];

/** No violation that axe can find, of all its usual rules or of some. */
export async function accessible(page: Page, what: string, rules: readonly string[] = []): Promise<void> {
    // Through the debugger: the policy of the page lets no script in.
    if (!(await page.evaluate(() => 'axe' in window))) {
        await page.evaluate(AXE);
    }
    const found = await page.evaluate(async (some) => {
        const { axe } = window as unknown as {
            axe: { run(options: object): Promise<{ violations: { id: string; help: string; nodes: { html: string }[] }[] }> };
        };
        // Axe describes elements at length, also those that pass; only violations are read.
        const only = some.length === 0 ? {} : { runOnly: { type: 'rule', values: some } };
        const { violations } = await axe.run({ resultTypes: ['violations'], ...only });
        return violations.map(({ id, help, nodes }) => `${id}: ${help}: ${nodes.map(({ html }) => html.slice(0, 200)).join(' | ')}`);
    }, rules);
    assert.deepEqual(found, [], what);
}

/** No violation that a dark page can have and not the same page in light: they differ in their colours alone. */
export const accessibleInDark = (page: Page, what: string): Promise<void> =>
    accessible(page, what, COLOUR_RULES);

/** Nothing is wider than the window. */
export async function fitsWindow(page: Page, what: string): Promise<void> {
    const [wide, shown] = await page.evaluate(() => [document.documentElement.scrollWidth, document.documentElement.clientWidth]);
    assert.ok(wide! <= shown!, `${what}: ${wide} of ${shown} pixels`);
}

/** Nothing is wrong with a page in light and dark, on a screen and on a phone. */
export async function looksRight({ page }: Opened, name: string): Promise<void> {
    const before = page.viewportSize()!;
    for (const [size, viewport] of Object.entries({ wide: { width: 1200, height: 850 }, phone: PHONE })) {
        await page.setViewportSize(viewport);
        for (const colorScheme of ['light', 'dark'] as const) {
            await page.emulateMedia({ colorScheme });
            // Charts follow the size of the window.
            await page.waitForTimeout(200);
            const what = `${name}, ${size}, ${colorScheme}`;
            await fitsWindow(page, what);
            await (colorScheme === 'light' ? accessible(page, what) : accessibleInDark(page, what));
            if (SHOTS !== '') {
                await page.screenshot({
                    path: join(SHOTS, `${name}-${size}-${colorScheme}.png`),
                    fullPage: true,
                });
            }
        }
    }
    await page.setViewportSize(before);
    await page.emulateMedia({ colorScheme: 'light' });
}

/**
 * The page asks the service again without waiting for its next round, as when somebody comes back to its tab.
 * For tests of what the page shows, not of when it asks.
 */
export const askAgain = (page: Page): Promise<void> =>
    page.evaluate(() => void document.dispatchEvent(new Event('visibilitychange')));

export async function finish({ page, complaints }: Opened, allowed: RegExp | null = null): Promise<void> {
    const wrong = complaints.filter((text) => allowed === null || !allowed.test(text));
    assert.deepEqual(wrong, [], 'the console and the policy have nothing to say');
    await page.context().close();
}
