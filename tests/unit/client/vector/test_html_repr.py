"""What a notebook shows is escaped and bounded, whatever names a worker gives."""

import base64
import re
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envhub_sandbox.vector.html_repr import environment_html, suites_html
from envhub_sandbox.vector.pictures import png

SCRIPT = "<script>steal()</script><img src=x onerror=steal()>\x1b[2J"
OURS = {"table", "tr", "th", "td", "code", "p"}


class Tags(HTMLParser):
    """Notes which elements there are, and that none has attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: set[str] = set()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[Any]) -> None:
        assert not attrs
        self.found.add(tag)

    def handle_data(self, data: str) -> None:
        self.text += f"{data} "


def an_env(name: str = "arm", **fields: Any) -> Any:
    space = gym.spaces.Dict({name: gym.spaces.Box(0, 1, (2,), np.float32)})
    kept = {"num_envs": 3, "single_observation_space": space, "closed": False}
    return SimpleNamespace(**{**kept, "single_action_space": gym.spaces.Discrete(4), **fields})


def test_a_box_is_shown_without_the_spaces_that_align_it() -> None:
    high = np.array([4.8, np.inf, 0.418])
    box = gym.spaces.Box(-high, high, dtype=np.float64)
    assert "  " in str(box)
    text = Tags(environment_html(an_env(single_observation_space=box), [])).text
    assert "Box([-4.8 -inf -0.418], [4.8 inf 0.418], (3,), float64)" in text


def test_spaces_and_layers_are_shown() -> None:
    held = [("seccomp", True), ("cgroup", False), ("seccomp", True), ("cgroup", True)]
    layers = [{"layer": name, "enforced": holds} for name, holds in held]
    text = Tags(environment_html(an_env(), layers)).text
    for word in ("3", "'arm': Box", "Discrete(4)", "seccomp", "open"):
        assert word in text
    suites = Tags(suites_html({"kitchen": {0: an_env(), "lift": an_env("leg")}})).text
    for word in ("kitchen", "0 ", "'lift'", "'leg': Box"):
        assert word in suites
    assert "1 layer: seccomp" in text
    assert "cgroup" not in text
    assert "does not run" in Tags(environment_html(an_env(), [])).text


def test_a_rendered_frame_is_a_picture() -> None:
    frame = np.full((600, 900, 3), 7, np.uint8)
    shown = environment_html(an_env(), [], frame)
    [data] = re.findall(r'<img alt="The last frame" src="data:image/png;base64,([^"]+)">$', shown)
    assert base64.b64decode(data) == png(frame[:150, :225])


@pytest.mark.parametrize(
    "rendered",
    [
        *(None, SCRIPT, 5, [[[1, 2, 3]]], np.zeros((4, 6, 3))),
        *(np.zeros((4, 6, 4), np.uint8), np.zeros((0, 6, 3), np.uint8), np.zeros(3, np.uint8)),
    ],
)
def test_what_is_no_frame_is_not_shown(rendered: object) -> None:
    assert environment_html(an_env(), [], rendered) == environment_html(an_env(), [])


def test_names_are_text_and_no_markup() -> None:
    env = an_env(SCRIPT)
    layers = [{"layer": SCRIPT, "enforced": True}]
    for shown in (environment_html(env, layers), suites_html({SCRIPT: {SCRIPT: env}})):
        assert Tags(shown).found <= OURS
        assert "steal()" in Tags(shown).text
        assert "\x1b" not in shown


def test_what_is_shown_is_bounded() -> None:
    env = an_env("x" * 100_000)
    tasks = dict.fromkeys(range(5000), env)
    shown = suites_html({"y" * 100_000: tasks})
    assert len(shown) < 100_000
    assert "4950 more" in shown
    assert len(environment_html(env, [{"layer": "z" * 100_000, "enforced": True}])) < 5_000
