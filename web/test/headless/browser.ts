// Chromium without a screen, drawing on the CPU.

import { existsSync } from 'node:fs';
import { type Browser, type BrowserContextOptions, type Page, chromium } from 'playwright-core';

const PATHS = ['/usr/bin/chromium-headless-shell', '/usr/bin/chromium', '/usr/bin/google-chrome'];
const FLAGS = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'];
/** The window of a page, pixels. */
export const WINDOW = { width: 1000, height: 700 };
/** Windows with a viewer are small where their size does not matter: without a graphics card it draws slowly. */
export const VIEWER_WINDOW = { width: 720, height: 320 };
/** A page that is not that of a phone, where the panel is below the picture. */
export const WIDE_WINDOW = { width: 800, height: 600 };
/** For tests that ask the viewer for pictures of their own, which are of any size. */
export const SMALL_WINDOW = { width: 660, height: 160 };

export function browserPath(): string | null {
    return process.env['CHROMIUM'] || (PATHS.find((path) => existsSync(path)) ?? null);
}

export async function launch(flags: readonly string[] = FLAGS): Promise<Browser> {
    const executablePath = browserPath();
    if (executablePath === null) {
        throw new Error('no Chromium: apt-get install chromium-headless-shell, or name it in CHROMIUM');
    }
    return chromium.launch({ executablePath, args: [...flags], headless: true });
}

/**
 * Makes the viewer in a page smaller than its page would let it be. After each picture that it is asked for it
 * draws its window again, which takes longer than the picture.
 */
export const shrinkViewer = (page: Page, width = 40, height = 30): Promise<void> =>
    page.locator('.fv-stage').evaluate(
        (stage: HTMLElement, style) => void Object.assign(stage.style, style),
        { flex: 'none', width: `${width}px`, height: `${height}px` },
    );

/** Gives the viewer back the place that its page has for it. */
export const unshrinkViewer = (page: Page): Promise<void> =>
    page.locator('.fv-stage').evaluate((stage: HTMLElement) => stage.removeAttribute('style'));

/** A token in an address: servers and proxies write addresses to their logs. */
const TOKEN = /fathom_[0-9a-f]+/;

/** A page that collects what the console and the policy complain about, and addresses that hold a token. */
export async function newPage(
    browser: Browser,
    options: BrowserContextOptions = {},
): Promise<{ page: Page; complaints: string[] }> {
    const context = await browser.newContext({ viewport: WINDOW, ...options });
    const page = await context.newPage();
    const complaints: string[] = [];
    page.on('console', (message) => {
        if (message.type() === 'error' || message.type() === 'warning') {
            complaints.push(message.text());
        }
    });
    page.on('pageerror', (error) => complaints.push(String(error)));
    context.on('request', (request) => {
        // No fragment is sent, so a link may carry a token there.
        const [sent = ''] = request.url().split('#');
        if (TOKEN.test(decodeURIComponent(sent)) || TOKEN.test(request.headers()['referer'] ?? '')) {
            complaints.push(`a token in an address: ${request.method()} ${new URL(sent).pathname}`);
        }
    });
    return { page, complaints };
}
