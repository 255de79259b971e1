"""A headless Chromium, driven through its debugging pipe: no driver, no port, nothing to install beside the browser."""

import contextlib
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Browser:
    """One page. ``run`` evaluates JavaScript, ``wait`` until it is true."""

    def __init__(self, profile: Path) -> None:
        read_command, self._out = os.pipe()
        self._in, write_answer = os.pipe()

        def wire() -> None:  # Chromium reads commands from descriptor 3 and answers on 4
            a, b = os.dup(read_command), os.dup(write_answer)
            os.dup2(a, 3)
            os.dup2(b, 4)

        assert CHROMIUM
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        self.process = subprocess.Popen(
            [CHROMIUM, *flags, "--remote-debugging-pipe", f"--user-data-dir={profile}", "about:blank"],
            preexec_fn=wire,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_command)
        os.close(write_answer)
        self._buffer, self._number, self._session = b"", 0, None
        self.problems: list[str] = []
        targets = self.send("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.send("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        screen = {"width": 1200, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **screen)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._buffer:
                more = os.read(self._in, 1 << 20)
                assert more, "the browser is gone"
                self._buffer += more
            text, _, self._buffer = self._buffer.partition(b"\0")
            answer = json.loads(text)
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.problems.append(json.dumps(answer["params"])[:500])
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, address: str) -> None:
        self.send("Page.navigate", url=address)

    def run(self, code: str) -> Any:
        found = self.send("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait(self, code: str, seconds: float = 60.0) -> None:
        """Return once ``code`` is true; a deadline, not a pace."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self.run(f"(() => {{ try {{ return !!({code}) }} catch (e) {{ return false }} }})()"):
                return
            time.sleep(0.05)
        raise AssertionError(f"never true: {code}; {self.problems}")

    def until(self, code: str, act: Callable[[], None], tries: int = 20) -> None:
        """``act`` again and again until ``code`` is true: a page that is still being laid out moves under the pointer."""
        for _ in range(tries):
            act()
            with contextlib.suppress(AssertionError):
                return self.wait(code, seconds=3)
        raise AssertionError(f"never true in {tries} tries: {code}; {self.problems}")

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        self.mouse("mouseMoved", x, y)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(20)
        os.close(self._in)
        os.close(self._out)
