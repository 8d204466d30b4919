"""``python -m tests.browser``: in Chromium, nothing of a hostile repository's runs or loads.

A repository that wrote markup wherever it may write is judged, its page is opened in headless
Chromium, and a server on loopback is told of whatever runs or loads there: nothing. The same page
with nothing escaped is the control, for each text by itself: what it would have done, it does. A
third page, unescaped behind our own policy, says that the policy holds alone.

Needs ``chromium`` (``apt-get install chromium``), which is why it is no test of ``./test``. With a
folder as argument it also leaves screenshots there: light and dark, wide and narrow, to look at.
"""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest import mock

from envhub_sandbox.check.findings import Report
from envhub_sandbox.check.judge import Asked, judge
from envhub_sandbox.check.page import page
from envhub_sandbox.check.table import Severity
from tests.support.repositories import write_repository
from tests.support.samples import EXAMPLES

# Each ends whatever it may stand in, and asks for its own address as soon as it is markup.
_ENDS = "</style></title></svg></code>\"'>"
_RUNS = {
    "script": "<script>new Image().src='URL'</script>",
    "onerror": "<img src=x: onerror=\"new Image().src='URL'\">",
    "onload": "<svg onload=\"new Image().src='URL'\">",
    "ontoggle": "<details open ontoggle=\"new Image().src='URL'\">",
    "onfocus": "<input autofocus onfocus=\"new Image().src='URL'\">",
    "javascript": "<iframe src=\"javascript:parent.fetch('URL',{mode:'no-cors'})\"></iframe>",
    "srcdoc": "<iframe srcdoc=\"<script>fetch('URL',{mode:'no-cors'})</script>\"></iframe>",
}
_LOADS = {
    "image": "<img src='URL'>",
    "video": "<video autoplay src='URL'>",
    "frame": "<iframe src='URL'></iframe>",
    "object": "<object data='URL'></object>",
    "css": "<style>body{background:url(URL)}</style>",
    "import": "<style>@import 'URL';</style>",
    "sheet": "<link rel=stylesheet href='URL'>",
    "attribute": "<p style='background:url(URL)'>x</p>",
    "prefetch": "<link rel=preload as=image href='URL'>",
}
_TEXTS = {**_RUNS, **_LOADS}
_SHOTS = {"wide": (1300, 2400), "narrow": (500, 3200)}
_REPOSITORY = '''
"""HOSTILE"""
import gymnasium as gym
import numpy as np

TEXTS = json_of_texts
ALL = " ".join(TEXTS)

def walk(text):
    class Walk(gym.Env):
        metadata = {"render_modes": ["rgb_array"], "render_fps": 1e300, text: ALL}
        render_mode = "rgb_array"
        observation_space = gym.spaces.Dict({text: gym.spaces.Box(-9, 9, (2,), np.float32)})
        action_space = gym.spaces.Discrete(2)
        count = 0

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {text: np.zeros(2, np.float32)}, {text: ALL}

        def step(self, action):
            type(self).count += 1
            if type(self).count > 3:
                raise ValueError("\\u202e" + text)
            return {text: np.zeros(2, np.float32)}, float("nan"), self.count > 2, False, {text: ALL}

        def render(self):
            pixels = np.frombuffer((text * 4096).encode()[: 48 * 64 * 3], np.uint8)
            return pixels.reshape(48, 64, 3)

    return Walk

def make_env(n_envs=1, use_async_envs=False):
    made = {text: gym.vector.SyncVectorEnv([walk(text)] * n_envs) for text in TEXTS}
    return {TEXTS[0]: made}
'''


class Listener:
    """A server on loopback, and what it was asked for."""

    def __init__(self) -> None:
        asked: set[str] = set()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                """Note what is asked for."""
                asked.add(self.path.strip("/"))
                self.send_response(404)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self.asked = asked
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def url(self, name: str) -> str:
        """The address by which one text is known."""
        return f"http://127.0.0.1:{self._server.server_port}/{name}"

    def close(self) -> None:
        """Listen no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def texts(listener: Listener) -> list[str]:
    """What the repository writes, each with an address of its own."""
    return [_ENDS + text.replace("URL", listener.url(name)) for name, text in _TEXTS.items()]


def hostile(folder: Path, listener: Listener) -> Path:
    """A repository that says these texts: as names, keys, documents, infos, errors, pixels."""
    every = texts(listener)
    code = _REPOSITORY.replace("json_of_texts", json.dumps(every)).replace("HOSTILE", "hostile")
    card = f"---\nlicense: {json.dumps(' '.join(every))}\n---\n# {' '.join(every)}\n"
    return write_repository(folder, code, README__md=card)


def judged(folder: Path, steps: int = 8) -> Report:
    """What a page is made of."""
    what = {"n_envs": 1}
    return judge(Asked(reference=str(folder), arguments=what, steps=steps, resets=1, pictures=True))


@contextmanager
def unescaped() -> Iterator[None]:
    """The twin: a page that takes a stranger's text for markup."""
    with mock.patch.object(html, "escape", lambda text, quote=True: text):
        yield


def chromium(*options: str) -> str:
    """What it prints; with a profile of its own, and long enough for what a page starts."""
    with tempfile.TemporaryDirectory(prefix="envhub-browser-") as profile:
        own = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars")
        more = (f"--user-data-dir={profile}", "--virtual-time-budget=4000", "--mute-audio")
        done = subprocess.run(
            ["chromium", *own, *more, "--autoplay-policy=no-user-gesture-required", *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            timeout=240,
            check=True,
        )
    return done.stdout


def asked_for(content: str, file: Path, listener: Listener) -> set[str]:
    """What a page has run or loaded, by the names of the texts."""
    listener.asked.clear()
    file.write_text(content, encoding="utf-8")
    chromium("--dump-dom", file.as_uri())
    return set(listener.asked)


def shown(content: str, file: Path) -> list[int]:
    """The widths of a page's pictures and films, as Chromium decodes them: 0 of what it cannot."""
    pictures = re.findall(r'<(?:img|video)[^>]* src="data:[^"]+"[^>]*>', content)
    script = """
    window.onload = () => setTimeout(() => {
      const all = [...document.querySelectorAll("img, video")]
      document.title = JSON.stringify(all.map(one => one.naturalWidth ?? one.videoWidth))
    }, 1000)"""
    page = f"<!doctype html><title></title>{''.join(pictures)}<script>{script}</script>"
    file.write_text(page, encoding="utf-8")
    [told] = re.findall("<title>(.*?)</title>", chromium("--dump-dom", file.as_uri()))
    widths: list[int] = json.loads(told)
    return widths


def screenshots(name: str, file: Path, folder: Path) -> None:
    """One page, as people with other screens see it."""
    for size, (width, height) in _SHOTS.items():
        for look, scheme in (("light", 1), ("dark", 0)):
            target = (folder / f"{name}-{size}-{look}.png").absolute()
            window = f"--window-size={width},{height}"
            setting = f"--blink-settings=preferredColorScheme={scheme}"
            chromium(window, setting, f"--screenshot={target}", file.as_uri())
            print(target, flush=True)


def main(arguments: list[str]) -> int:
    """Open the pages, and say what they did; 0 if that is what they should have done."""
    if shutil.which("chromium") is None:
        print("needs chromium: apt-get install chromium", file=sys.stderr)
        return 2
    listener = Listener()
    try:
        with tempfile.TemporaryDirectory(prefix="envhub-pages-") as folder:
            return _looked(Path(folder), listener, [Path(one) for one in arguments[:1]])
    finally:
        listener.close()


def _looked(folder: Path, listener: Listener, shots: list[Path]) -> int:
    report = judged(hostile(folder / "hostile", listener))
    failures = report.failures(Severity.WARNING)
    content = page(report, failures)
    with unescaped():
        guarded = page(report, failures)
        bare = re.sub("<meta http-equiv=[^>]*>", "", guarded)
    found = {
        "the page": asked_for(content, folder / "hostile.html", listener),
        "unescaped, behind the policy": asked_for(guarded, folder / "guarded.html", listener),
        "unescaped, with no policy": asked_for(bare, folder / "bare.html", listener),
    }
    for name, asked in found.items():
        print(f"{name}: {', '.join(sorted(asked)) or 'nothing'}", flush=True)
    honest = page(judged(EXAMPLES / "cartpole", steps=200), [])
    (folder / "honest.html").write_text(honest, encoding="utf-8")
    widths = shown(honest, folder / "shown.html")
    print(f"pictures of the honest page: {widths}", flush=True)
    for one in shots:
        one.mkdir(parents=True, exist_ok=True)
        for name in ("honest", "hostile"):
            screenshots(name, folder / f"{name}.html", one)
    missing = set(_TEXTS) - found["unescaped, with no policy"]
    print(f"the control has done all but: {', '.join(sorted(missing)) or 'nothing'}")
    held = not found["the page"] and not found["unescaped, behind the policy"]
    return 0 if held and not missing and len(widths) > 3 and all(widths) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
