"""Chromium without a screen, driven by the DevTools protocol through a pair of pipes: no package, no port."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from patience import PATIENCE

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
)
KEYS = {"ArrowUp": 38, "ArrowDown": 40, "ArrowLeft": 37, "ArrowRight": 39, "Enter": 13, "Tab": 9, " ": 32}

BOX = """const box = async (each) => {  // once it has stood still for three frames: cards are placed a frame later
  let now = [], still = 0;
  while (still < 3) {
    await new Promise(requestAnimationFrame);
    const before = now;
    each.scrollIntoView({ block: "center" });
    const { left, top, width, height } = each.getBoundingClientRect();
    now = [left, top, width, height];
    still = now.every((number, i) => number === before[i]) ? still + 1 : 0;
  }
  return now;
}"""


def program():
    """Where Chromium is; None where there is none."""
    return os.environ.get("CHROME") or next(filter(None, map(shutil.which, PROGRAMS)), None)


class Page:
    """A page of a browser of its own.

    Attributes:
        faults: what the page's script threw, and what it was not allowed to load.
    """

    def __init__(self, width=1280, height=900, *, dark=False, touch=False):
        self.folder = tempfile.mkdtemp()
        to_read, self.to = os.pipe()
        self.source, to_write = os.pipe()
        command = [program(), *FLAGS, "--remote-debugging-pipe", f"--user-data-dir={self.folder}", "about:blank"]
        high = {3: to_read, 4: to_write}

        def place():
            copies = {number: os.dup(end) for number, end in high.items()}
            for number, end in copies.items():
                os.dup2(end, number)

        self.process = subprocess.Popen(
            command, preexec_fn=place, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(to_read), os.close(to_write)
        self.number, self.rest, self.session, self.faults = 0, b"", None, []
        (target,) = (each for each in self.send("Target.getTargets")["targetInfos"] if each["type"] == "page")
        self.session = self.send("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        self.size(width, height)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.send("Emulation.setEmulatedMedia", features=scheme)

    def send(self, method, **params):
        """The result of a command of the protocol."""
        self.number += 1
        message = {"id": self.number, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self.number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def _next(self):
        while b"\0" not in self.rest:
            more = os.read(self.source, 1 << 16)
            assert more, "the browser went away"
            self.rest += more
        line, _, self.rest = self.rest.partition(b"\0")
        answer = json.loads(line)
        if answer.get("method") == "Runtime.exceptionThrown":
            self.faults.append(answer["params"]["exceptionDetails"]["exception"].get("description"))
        if answer.get("method") == "Log.entryAdded" and answer["params"]["entry"]["level"] == "error":
            self.faults.append(answer["params"]["entry"]["text"])
        return answer

    def size(self, width, height=900):
        """The size of the window, in CSS pixels."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def open(self, url):
        """Load a page, and wait until its script says that it is ready."""
        self.send("Page.navigate", url="about:blank")  # the same address with another hash would load nothing
        self.send("Page.navigate", url=url)
        self.until("document.documentElement && document.documentElement.dataset.ready === 'yes'")

    def value(self, expression, functions=""):
        """The value of an expression of the page, which may use some functions."""
        expression = f"(() => {{ {functions}; return {expression}; }})()" if functions else expression
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression, seconds=PATIENCE):
        """Wait until an expression is true."""
        script = (
            "new Promise((done) => { const began = Date.now(); const look = () => { let is = false; "
            f"try {{ is = {expression}; }} catch {{}} if (is || Date.now() - began > {1000 * seconds}) "
            "done(Boolean(is)); else setTimeout(look, 20); }; look(); })"
        )
        for _ in range(3):  # a page that is left on the way takes the promise with it
            answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
            if answer["result"].get("value") is True:
                return
        raise AssertionError(
            f"{expression} is not true; faults: {self.faults}; {self.value('document.body.innerText')[:500]}"
        )

    def text(self, selector):
        """The text of the first element that a selector finds."""
        return self.value(f"document.querySelector({json.dumps(selector)}).innerText")

    def press(self, key):
        """Press a key as a keyboard does."""
        code = KEYS.get(key, ord(key[0].upper()))
        typed = {"Enter": "\r"}.get(key, key if len(key) == 1 else None)
        given = {"key": key, "windowsVirtualKeyCode": code, **({"text": typed} if typed else {})}
        self.send("Input.dispatchKeyEvent", type="keyDown", **given)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)

    def click(self, selector, x=0.5, y=0.5):
        """Click on an element with the mouse, at a place of it."""
        box = self.value(f"box(document.querySelector({json.dumps(selector)}))", BOX)
        at = {"x": box[0] + x * box[2], "y": box[1] + y * box[3], "button": "left", "clickCount": 1}
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, **at)

    def picture(self, path, *, whole=True):
        """Write a picture of the page."""
        data = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole, **self._whole(whole))[
            "data"
        ]
        Path(path).write_bytes(base64.b64decode(data))

    def _whole(self, whole):
        if not whole:
            return {}
        width, height = self.value("[document.documentElement.clientWidth, document.documentElement.scrollHeight]")
        return {"clip": {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}}

    def close(self):
        """End the browser."""
        self.process.kill()
        self.process.wait()
        os.close(self.to), os.close(self.source)
        shutil.rmtree(self.folder, ignore_errors=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
