// Chromium without a screen, drawing on the CPU.

import { existsSync } from 'node:fs';
import { type Browser, type BrowserContextOptions, type Page, chromium } from 'playwright-core';

const PATHS = ['/usr/bin/chromium-headless-shell', '/usr/bin/chromium', '/usr/bin/google-chrome'];
const FLAGS = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'];
/** The window of a page, pixels. */
export const WINDOW = { width: 1000, height: 700 };
/** For tests that ask the viewer for pictures of their own: after each it draws its window again. */
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
