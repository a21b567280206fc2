# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A real browser, in which a person's hands are played: mouse and keys on the capture page."""

from contextlib import contextmanager
import shutil

import pytest

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
ARGUMENTS = ('--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run', '--disable-sync',
             '--disable-background-networking', '--disable-component-update')
PATIENCE = 60_000  # ms
DESKTOP, TELEPHONE = (1280, 800), (390, 844)
STEPS = ('Photographs', 'Scale', 'DLO', 'Hands', 'Calibrate')


@contextmanager
def browser():
    """Give the machine's browser; skip the test where there is none."""
    playwright = pytest.importorskip('playwright.sync_api', reason='no playwright is installed')
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip('no Chromium is installed')
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield started
        started.close()


class Tab:
    """A window with the capture page, and the errors that it reported."""

    def __init__(self, browser, address, size=DESKTOP, **how):
        self.context = browser.new_context(viewport={'width': size[0], 'height': size[1]}, **how)
        self.context.set_default_timeout(PATIENCE)
        self.page = self.context.new_page()
        self.complaints = []
        self.page.on('pageerror', lambda error: self.complaints.append(str(error)))
        self.page.on('console', lambda message: message.type == 'error'
                     and self.complaints.append(message.text))
        self.page.goto(address)
        self.find('#title').wait_for()

    def find(self, selector):
        """Return what a selector names."""
        return self.page.locator(selector)

    def button(self, name):
        """Return the button with a name."""
        return self.page.get_by_role('button', name=name)

    def field(self, label):
        """Return the field with a label."""
        return self.page.get_by_label(label)

    def step(self, name):
        """Go to a step."""
        self.find('.steps button').nth(STEPS.index(name)).click()
        self.page.get_by_role('heading', name=name, level=2).wait_for()

    def photograph(self, role):
        """Go to a photograph of the first trial: Start or Goal."""
        self.find(f'#strip button[aria-label^="{role} of trial 1"]').click()
        self.find(f'#stage[aria-label*="{role.lower()} of trial 1"]').wait_for()

    def place(self, pixel):
        """Return where on the screen a pixel of the photograph is."""
        self.find('#stage[aria-busy="false"]').wait_for()
        left, top, wide, width = self.find('#pictures').evaluate("""one => {
            const box = one.getBoundingClientRect();
            return [box.left, box.top, box.width, one.offsetWidth]; }""")
        return tuple(edge + (pixel[k] + 0.5) * wide / width for k, edge in enumerate((left, top)))

    def click(self, pixel):
        """Click at a pixel of the photograph."""
        self.page.mouse.click(*self.place(pixel))

    def drag(self, begin, end):
        """Drag from one pixel of the photograph to another."""
        self.page.mouse.move(*self.place(begin))
        self.page.mouse.down()
        self.page.mouse.move(*self.place(end), steps=4)
        self.page.mouse.up()

    def clicked(self, pixels):
        """Click along the DLO, and wait for each mark."""
        for pixel in pixels:
            before = self.find('#drawn .click').count()
            self.click(pixel)
            self.mark(f'click {before}').wait_for()

    def mark(self, name):
        """Return a mark on the photograph."""
        return self.find(f'[data-mark="{name}"]')

    def keys(self, *keys):
        """Press keys."""
        for key in keys:
            self.page.keyboard.press(key)

    def violations(self):
        """Return the violations that axe reports of the page, each with its first place."""
        axe = pytest.importorskip('axe_playwright_python.sync_playwright', reason='no axe is installed')
        violations = axe.Axe().run(self.page).response['violations']
        return [f'{violation["id"]}: {violation["nodes"][0]["html"][:200]}' for violation in violations]

    def overflow(self):
        """Return by how many pixels the page or its panel would have to be scrolled sideways."""
        return self.page.evaluate("""() => Math.max(...['html', '#panel', '#top'].map((name) => {
            const one = document.querySelector(name);
            return one.scrollWidth - one.clientWidth; }))""")

    def close(self):
        """Close the window."""
        self.context.close()
