"""The page in a real browser: `python docs/live/check.py` prints how it agrees with `simulate`, and its frame rate."""

import argparse
import fcntl
import json
import os
import shutil
import tempfile
import time
from base64 import b64decode
from pathlib import Path
from typing import Any

import jax
import numpy as np
from build import build, exact_scenes

import jaxmodsim as jms
from jaxmodsim.scene import replace_numbers, scene_numbers

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
MOST_BYTES, LEAST_RATE, MOST_ERROR = 1_000_000, 30.0, 2e-3

# Sets sliders, by the numbers that they are of, and resolves with what was run next.
MOVED = """(async (machine, positions) => {
  choose(machine);
  for (const [name, position] of Object.entries(positions)) {
    const slider = document.querySelector(`[data-number="${name}"]`);
    slider.value = position;
    slider.dispatchEvent(new Event("input"));
  }
  while (state.changed || state.busy) await new Promise(requestAnimationFrame);
  const out = { values: state.values };
  for (const law of LAWS) {
    const { t, q, error, solved } = state.runs[law];
    out[law] = { t: [...t], q: [...q], error, solved };
  }
  return JSON.stringify(out);
})"""
# Moves a slider in every frame for some seconds; resolves with the frames a second.
DRAGGED = """(async (seconds) => {
  const slider = document.querySelector("[data-number]");
  const began = performance.now();
  let frames = 0;
  while (performance.now() - began < 1e3 * seconds) {
    slider.value = 0.5 + 0.4 * Math.sin(frames / 20);
    slider.dispatchEvent(new Event("input"));
    await new Promise(requestAnimationFrame);
    ++frames;
  }
  return JSON.stringify(1e3 * frames / (performance.now() - began));
})"""


class Browser:
    """A headless browser with one page, spoken to through a pipe by its own protocol."""

    def __init__(self, program: str, page: Path, profile: str) -> None:
        to_browser, self._write = os.pipe()
        self._read, from_browser = os.pipe()
        # The browser reads 3 and writes 4: the ends are moved away from there before they become these.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in (to_browser, from_browser)]
        flags = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--remote-debugging-pipe",
            f"--user-data-dir={profile}",
        ]
        self._process = os.posix_spawn(
            program,
            [program, *flags, "--window-size=1360,900", "about:blank"],
            os.environ,
            file_actions=[
                *((os.POSIX_SPAWN_DUP2, end, number) for end, number in zip(ends, (3, 4), strict=True)),
                *((os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_WRONLY, 0) for number in (1, 2)),
            ],
        )
        for end in (to_browser, from_browser, *ends):
            os.close(end)
        self._count, self._rest = 0, b""
        targets = self._call("Target.getTargets")["targetInfos"]
        target = next(each["targetId"] for each in targets if each["type"] == "page")
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._call("Network.enable")
        nothing = {"latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
        self._call("Network.emulateNetworkConditions", offline=True, **nothing)
        self._call("Page.navigate", url=page.resolve().as_uri())
        while not self.evaluate("String(document.readyState === 'complete' && state.runs !== null)"):
            time.sleep(0.05)

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if hasattr(self, "_session"):
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._rest:
                more = os.read(self._read, 1 << 20)
                if not more:
                    raise RuntimeError("The browser has ended.")
                self._rest += more
            line, self._rest = self._rest.split(b"\0", 1)
            answer = json.loads(line)
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def evaluate(self, expression: str) -> Any:
        """Value of an expression or a promise that gives JSON."""
        done = self._call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in done:
            raise RuntimeError(json.dumps(done["exceptionDetails"]))
        return json.loads(done["result"]["value"])

    def screenshot(self, out: Path) -> None:
        """Write the page as it is seen to a PNG file."""
        out.write_bytes(b64decode(self._call("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        """End the browser."""
        del self._session  # of the page; the browser itself is meant
        self._call("Browser.close")
        os.waitpid(self._process, 0)
        os.close(self._write)
        os.close(self._read)


def open_page(folder: Path) -> Browser:
    """The page in a browser.

    **Raises:**

    - `RuntimeError` if there is none.
    """
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise RuntimeError(f"No browser: one of {', '.join(BROWSERS)} is needed, as by `apt-get install chromium`.")
    return Browser(program, build(folder / "live.html"), str(folder / "profile"))


def errors(browser: Browser, machine: str, positions: dict[str, float]) -> list[tuple[float, float]]:
    """Error of each law's positions and the page's estimate of it, relative to the largest position.

    The reference is `simulate` with `rtol=1e-9` and, for Coulomb friction, exact stick.

    **Raises:**

    - `RuntimeError` if the page did not solve a step.
    """
    moved = browser.evaluate(f"{MOVED}({json.dumps(machine)}, {json.dumps(positions)})")
    out = []
    for law in ("lugre", "coulomb"):
        page = moved[law]
        if not page["solved"]:
            raise RuntimeError(f"{machine}, {law}: a step of the page was not solved.")
        scene = exact_scenes()[machine + law.capitalize()]
        known = scene_numbers(scene)
        scene = replace_numbers(scene, {k: np.asarray(x, float) for k, x in moved["values"].items() if k in known})
        ts, tight = np.array(page["t"]), {"rtol": 1e-9, "atol": 1e-12, "max_steps": 10**6}
        q = np.asarray(jms.simulate(scene, [0.0], [0.0], ts[-1], ts=ts, **tight).q[:, 0])
        largest = np.max(np.abs(q))
        out.append((float(np.max(np.abs(q - page["q"])) / largest), page["error"] / float(largest)))
    return out


# Machines, and positions of their sliders from 0 to 1.
CASES = (
    ("belt", {}),
    ("belt", {"friction.sigma0": 0.3, "friction.sigma1": 0.8, "friction.Fs": 0.7, "friction.belt_velocity": 0.4}),
    ("belt", {"friction.vs": 0.1, "friction.Fs": 1.0}),
    ("box", {}),
    ("box", {"friction.sigma0": 0.9, "friction.Fs": 0.6, "friction.vs": 0.2, "friction.belt_velocity": 0.3}),
)


def main() -> None:
    """Check everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--screenshots", type=Path, help="folder for a picture of each machine")
    out = parser.parse_args().screenshots
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as folder:
        browser = open_page(Path(folder))
        try:
            text = (Path(folder) / "live.html").read_text()
            loads = [word for word in ("http:", "https:", "src=", "import ", "fetch(") if word in text]
            found = [pair for machine, positions in CASES for pair in errors(browser, machine, positions)]
            rates = {}
            for machine in ("belt", "box"):
                browser.evaluate(f"(choose('{machine}'), '1')")
                # The best of some, as other programs may run beside.
                rates[machine] = max(browser.evaluate(f"{DRAGGED}(2)") for _ in range(4))
                if out is not None:
                    out.mkdir(parents=True, exist_ok=True)
                    browser.screenshot(out / f"{machine}.png")
        finally:
            browser.close()
    for error, estimate in found:
        print(f"position: error {100 * error:.3f} %, estimate on the page {100 * estimate:.3f} %")
    worst = max(error for error, _ in found)
    print(
        "frames a second while a slider moves:", ", ".join(f"{rate:.0f} ({machine})" for machine, rate in rates.items())
    )
    print(f"{len(text)} bytes")
    if loads:
        raise SystemExit(f"The page may load files: it contains {', '.join(map(repr, loads))}.")
    if len(text) > MOST_BYTES or worst > MOST_ERROR or min(rates.values()) < LEAST_RATE:
        raise SystemExit(f"Needed: {MOST_BYTES} bytes, an error of {MOST_ERROR}, {LEAST_RATE} frames a second.")


if __name__ == "__main__":
    main()
