"""Headless Chromium, driven by its DevTools protocol over a WebSocket."""

import base64
import itertools
import json
import math
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Tab:
    def __init__(self, socket: Any, downloads: Path, width: int, height: int) -> None:
        self._socket, self._numbers = socket, itertools.count(1)
        self.console: list[Any] = []
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        self.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(downloads))
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **size)

    def post(self, method: str, **given: Any) -> int:
        """Send a command without waiting for its answer, and return its number."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": given}))
        return number

    def send(self, method: str, **given: Any) -> Any:
        number = self.post(method, **given)
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            assert "error" not in answer, answer
            if answer.get("method") in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
                self.console.append(answer["params"])
            if answer.get("id") == number:
                return answer["result"]

    def run(self, code: str) -> Any:
        found = self.send("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, code: str, seconds: float = 300.0) -> Any:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = self.run(f"(() => {{ try {{ return {code} }} catch {{ return null }} }})()")
            if found:
                return found
            time.sleep(0.05)
        raise TimeoutError(code)

    def mouse(self, kind: str, x: float, y: float) -> None:
        held = {"button": "left", "clickCount": 1} if kind != "mouseMoved" else {}
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held)

    def click(self, x: float, y: float, times: int = 1) -> None:
        for kind in ("mouseMoved", *("mousePressed", "mouseReleased") * times):
            self.mouse(kind, x, y)

    def drag(self, x0: float, y0: float, x1: float, y1: float, *, seconds: float = 0.5, held_s: float = 0.0) -> None:
        """Press, hold still, move on an arc with 60 moves a second, and release; events do not wait for answers."""
        self.mouse("mouseMoved", x0, y0)
        self.mouse("mousePressed", x0, y0)
        time.sleep(held_s)
        for part in np.linspace(0.0, 1.0, round(60 * seconds) + 1)[1:].tolist():
            bend = 0.1 * math.sin(math.pi * part)
            x, y = x0 + part * (x1 - x0) + bend * (y1 - y0), y0 + part * (y1 - y0) + bend * (x0 - x1)
            self.post("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1)
            time.sleep(1 / 60)
        self.mouse("mouseReleased", x1, y1)

    def choose_files(self, selector: str, *paths: Path) -> None:
        root = self.send("DOM.getDocument")["root"]["nodeId"]
        node = self.send("DOM.querySelector", nodeId=root, selector=selector)["nodeId"]
        self.send("DOM.setFileInputFiles", nodeId=node, files=[str(path) for path in paths])

    def faults(self) -> list[Any]:
        """Return what the page has logged as a warning or an error, exceptions included."""
        logged = [
            (entry.get("type", entry.get("entry", {}).get("level", "exception")), entry) for entry in self.console
        ]
        return [entry for kind, entry in logged if kind not in ("log", "info", "debug", "verbose")]

    def screenshot(self, path: Path, *, part: tuple[float, float, float, float] | None = None) -> None:
        """Write a PNG of the window, or a part of it: left, top, width and height."""
        self.send("Page.bringToFront")
        names = ("x", "y", "width", "height")
        clip = {} if part is None else {"clip": dict(zip(names, part, strict=True)) | {"scale": 1}}
        picture = self.send("Page.captureScreenshot", format="png", **clip)["data"]
        path.write_bytes(base64.b64decode(picture))


@contextmanager
def chromium(folder: Path) -> Iterator[Any]:
    """Start a browser and yield what opens tabs in it."""
    assert CHROMIUM
    options = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run")
    ports = folder / "profile" / "DevToolsActivePort"
    command = [CHROMIUM, *options, "--remote-debugging-port=0", f"--user-data-dir={ports.parent}", "about:blank"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with ExitStack() as stack:
        stack.callback(process.wait, 20)
        stack.callback(process.terminate)
        while not (ports.exists() and len(ports.read_text().split()) == 2):
            assert process.poll() is None
            time.sleep(0.1)
        port = ports.read_text().split()[0]

        def open_tab(url: str, width: int = 1280, height: int = 1000) -> Tab:
            request = urllib.request.Request(f"http://127.0.0.1:{port}/json/new?about:blank", method="PUT")
            with urllib.request.urlopen(request) as answer:
                address = json.load(answer)["webSocketDebuggerUrl"]
            tab = Tab(stack.enter_context(connect(address, max_size=None)), folder, width, height)
            tab.send("Page.navigate", url=url)
            return tab

        yield open_tab
