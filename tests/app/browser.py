"""A headless Chromium, spoken to through a pipe: no driver and no package is needed beside the browser itself."""

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from contextlib import contextmanager

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 60
"""Seconds for one answer."""


def found():
    """The browser's program; None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page in one browser; `events` has what the browser told meanwhile, as (method, parameters)."""

    def __init__(self, send, receive):
        self._send, self._receive, self._buffer, self._last = send, receive, b"", 0
        self.events = []
        targets = self.call("Target.getTargets", session=None)["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        self._session = None
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network", "Accessibility"):
            self.call(f"{domain}.enable")

    def call(self, method, session=..., **parameters):
        """One command of the DevTools protocol, and its result."""
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters}
        if session is ... and getattr(self, "_session", None):
            message["sessionId"] = self._session
        os.write(self._send, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._last:
                assert "error" not in answer, answer
                return answer["result"]

    def _next(self):
        end = time.monotonic() + PATIENCE
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._receive], [], [], max(0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            data = os.read(self._receive, 1 << 20)
            assert data, "the browser is gone"
            self._buffer += data
        line, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(line)
        if "method" in message:
            self.events.append((message["method"], message["params"]))
        return message

    def open(self, path, *, width=1280, height=900, scheme="light", hash_=""):
        """Load a file, and wait until all of it is there and shown: a browser drops keys that come before the first picture."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self.call("Page.navigate", url="about:blank")
        self.events.clear()
        self.call("Page.navigate", url=path.resolve().as_uri() + hash_)
        while "Page.loadEventFired" not in [method for method, _ in self.events]:
            self._next()
        self.do("Promise.all([...document.images].map(image => image.decode()))")
        for _ in range(2):
            self.do("new Promise(requestAnimationFrame)")

    def do(self, expression):
        """The value of an expression in the page, waited for where it is a promise."""
        found = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def press(self, key, *, shift=False):
        """Press a key as a user would."""
        codes = {"ArrowLeft": 37, "ArrowRight": 39, "Tab": 9, "Enter": 13}
        text = key if len(key) == 1 else "\r" if key == "Enter" else ""
        code = codes.get(key, ord(key.upper()) if len(key) == 1 else 0)
        parameters = {"key": key, "code": key, "windowsVirtualKeyCode": code, "modifiers": 8 * shift}
        self.call("Input.dispatchKeyEvent", type="keyDown", text=text, **parameters)
        self.call("Input.dispatchKeyEvent", type="keyUp", **parameters)
        self.do("new Promise(requestAnimationFrame)")

    def drag(self, start, end):
        """Drag the mouse from one place (x, y) of the window to another."""
        for kind, (x, y), buttons in (("mousePressed", start, 1), ("mouseMoved", end, 1), ("mouseReleased", end, 0)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)
        self.do("new Promise(requestAnimationFrame)")

    def box(self, selector):
        """Left, top, width, height of an element in the window, scrolled to."""
        return self.do(
            f"(e => {{ e.scrollIntoView({{block: 'center'}}); const b = e.getBoundingClientRect();"
            f" return [b.x, b.y, b.width, b.height] }})(document.querySelector({json.dumps(selector)}))"
        )

    def complaints(self):
        """Errors on the console, and addresses asked for that are not on this disk."""
        said = []
        for method, of in self.events:
            if method == "Runtime.exceptionThrown" or (
                method == "Runtime.consoleAPICalled" and of["type"] in ("error", "warning")
            ):
                said.append(str(of))
            elif method == "Log.entryAdded" and of["entry"]["level"] in ("error", "warning"):
                said.append(of["entry"]["text"])
            elif method == "Network.requestWillBeSent" and not of["request"]["url"].startswith(("file:", "data:", "about:")):
                said.append(f"request to {of['request']['url']}")
        return said

    def unnamed(self):
        """What can be operated or is a picture, but has no name for those who do not see it."""
        nodes = self.call("Accessibility.getFullAXTree")["nodes"]
        roles = {
            "button",
            "link",
            "combobox",
            "slider",
            "image",
            "textbox",
            "checkbox",
            "radio",
            "toolbar",
            "region",
            "navigation",
        }
        return [
            node["role"]["value"]
            for node in nodes
            if not node["ignored"] and node["role"]["value"] in roles and not node.get("name", {}).get("value")
        ]

    def screenshot(self, path):
        """What the window shows, as a PNG."""
        shot = self.call("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))


@contextmanager
def browser():
    """A browser with an empty profile; it ends with the block."""
    to_browser, from_us = os.pipe()
    from_browser, to_us = os.pipe()
    # The protocol's pipe has the numbers 3 and 4.
    command = 'exec 3<&"$1" 4>&"$2"; shift 2; exec "$@"'
    with tempfile.TemporaryDirectory(prefix="stss-browser-") as profile:
        options = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--allow-pre-commit-input",
            "--hide-scrollbars",
        ]
        program = subprocess.Popen(
            ["bash", "-c", command, "bash", str(to_browser), str(to_us), found(), *options, f"--user-data-dir={profile}",
             "--remote-debugging-pipe", "about:blank"],
            pass_fds=(to_browser, to_us),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(to_us)
        try:
            yield Browser(from_us, from_browser)
        finally:
            os.close(from_us)
            os.close(from_browser)
            try:
                program.wait(10)
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()
