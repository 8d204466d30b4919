"""Hostile repositories, and the pages that are made of what ``check`` says of them."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

from envhub_sandbox.check.findings import Report
from envhub_sandbox.check.judge import judge
from envhub_sandbox.check.settings import JudgeOptions
from tests.browser.texts import ODD
from tests.support.repositories import write_repository

SHAPE = (48, 64, 3)
"""Of a frame whose bytes are markup."""
_WALKS = '''
"""hostile"""
import gymnasium as gym
import numpy as np

TEXTS = json_of_texts
ODD = json_of_odd
ALL = " ".join(TEXTS)
SHAPE = shape_of_frames

def walk(text, draws):
    class Walk(gym.Env):
        metadata = {"render_modes": ["rgb_array"], "render_fps": 1e300, text: ALL}
        render_mode = "rgb_array"
        observation_space = gym.spaces.Dict({text + ODD: gym.spaces.Box(-9, 9, (2,), np.float32)})
        action_space = gym.spaces.Discrete(2)
        count = 0

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return {text + ODD: np.zeros(2, np.float32)}, {ODD + text: ALL}

        def step(self, action):
            type(self).count += 1
            if type(self).count > 3:
                raise ValueError(ODD + text)
            seen = {text + ODD: np.zeros(2, np.float32)}
            return seen, float("nan"), self.count > 2, False, {ODD + text: ALL}

        def render(self):
            if not draws:
                raise ValueError(text)
            size = np.prod(SHAPE)
            return np.frombuffer((text * size).encode()[:size], np.uint8).reshape(SHAPE)

    return Walk

def make_env(n_envs=1, use_async_envs=False):
    made = {
        text: gym.vector.SyncVectorEnv([walk(text, number < 3)] * n_envs)
        for number, text in enumerate(TEXTS)
    }
    return {TEXTS[0]: made}
'''


def walks(folder: Path, texts: list[str]) -> Report:
    """A repository that says the texts as names, keys, documents, infos, errors and pixels."""
    code = _WALKS.replace("json_of_texts", json.dumps(texts)).replace(
        "json_of_odd", json.dumps(ODD)
    )
    code = code.replace("shape_of_frames", str(SHAPE))
    card = f"---\nlicense: {json.dumps(' '.join(texts))}\n---\n# {' '.join(texts)}\n"
    return judged(write_repository(folder, code, README__md=card), pictures=True)


def declares(folder: Path, texts: list[str]) -> Report:
    """One that says them as what it requires, and as names of files, each with much to tell of."""
    wants = "\n".join([*texts, *(f"numpy; python_version < {text!r}" for text in texts)])
    write_repository(folder, "def make_env(**_): raise ValueError", requirements__txt=wants)
    for text in texts:
        file = folder / f"{text}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("import socket\neval(input())\n")
    return judged(folder)


def judged(folder: Path, steps: int = 8, *, pictures: bool = False) -> Report:
    """What a page is made of."""
    what = {"n_envs": 1}
    asked = JudgeOptions(
        reference=str(folder), arguments=what, steps=steps, resets=1, pictures=pictures
    )
    return judge(asked)


@contextmanager
def unescaped() -> Iterator[None]:
    """The twin: a page that takes a stranger's text for markup."""
    with mock.patch.object(html, "escape", lambda text, quote=True: text):
        yield


def without_policy(content: str) -> str:
    """The same page, which forbids the browser nothing."""
    return re.sub("<meta http-equiv=[^>]*>", "", content, count=1)
