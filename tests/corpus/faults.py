"""Repositories with one fault each, and the check that has to find it.
Those of seeds, types, rewards and renderings are what people report to Gymnasium, Stable-Baselines3
and LeRobot (Gymnasium 899, 914, 1084, 1179, 1207, 1445; gym 980, 1420; Stable-Baselines3 1132,
1151; gym-pusht 27; RLBench 48; ManiSkill 320)."""

import io
import py_compile
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any

from tests.corpus.entries import Entry


def _fault(group: str, told: str, env: str = "", **more: Any) -> Entry:
    return Entry(group=group, told=told, env=env, **more)


def _returned(told: str, of: str, *also: str, head: str = "") -> Entry:
    code = f"{head}\ndef make_env(n_envs=1, use_async_envs=False):\n    return {of}\n"
    return Entry(group="loading", told=told, also=frozenset(also), code=code)


def _batch(told: str, step: str, mode: str = "NEXT_STEP", **more: Any) -> Entry:
    """A vector environment whose ``step`` changes what Gymnasium's gives."""
    code = f"""
class Batch(gym.vector.SyncVectorEnv):
    late = None

    def step(self, actions):
        seen, rewards, terminated, truncated, infos = super().step(actions)
        {step}
        return seen, rewards, terminated, truncated, infos

def make_env(n_envs=1, use_async_envs=False):
    return Batch([Env] * n_envs, autoreset_mode=gym.vector.AutoresetMode.{mode})
"""
    return Entry(group="vectors", told=told, code=code, **more)


def _compiled() -> bytes:
    with tempfile.TemporaryDirectory(prefix="envhub-corpus-") as folder:
        source = Path(folder, "walking.py")
        source.write_text("SIZE = 1\n")
        py_compile.compile(str(source), str(source) + "c", doraise=True)
        return Path(f"{source}c").read_bytes()


def _archive() -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("more.py", "SIZE = 1\n")
    return packed.getvalue()


_WIDE = "observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)\n"
_SEEN = "def observation(self):\n    return "
_REWARD = "def reward(self):\n    return "
_LATE = "def is_late(self):\n    return "
_INFO = "def info(self):\n    return "
_RENDER = "def render(self):\n    return "
_RESET = "def reset(self, **kwargs):\n    "
_RESULT = "\n    return super().reset(**kwargs)"
_STEP = "def step(self, action):\n    "
_STEPPED = "\n    return super().step(action)"
_OBSERVATIONS = {
    "observation-dtype": {
        "64 bits for 32": _SEEN + "np.array([self.at, self.count])",
        "whole numbers for floats": _SEEN + "np.array([0, self.count])",
        "a list for an array": _SEEN + "[self.at, self.count]",
        "a tuple for an array": _SEEN + "(self.at, self.count)",
        "64 bits after the reset": _STEP
        + "_, *rest = super().step(action)\n    return np.array([self.at, 0.0]), *rest",
    },
    "runs": {
        "another shape": _SEEN + "np.zeros(3, np.float32)",
        "channels in front": "observation_space = gym.spaces.Box(0, 255, (8, 9, 3), np.uint8)\n"
        + (_SEEN + "np.zeros((3, 8, 9), np.uint8)"),
        "nothing": _SEEN + "None",
        "nothing at the end": _SEEN + "None if self.count >= 12 else super().observation()",
        "a key too few": "observation_space = gym.spaces.Dict({'a': Walk.observation_space, 'b': "
        + ("gym.spaces.Discrete(3)})\n" + _SEEN + "{'a': super().observation()}"),
    },
    "observation-space": {
        "beyond the bounds": _SEEN + "np.array([self.at, 30 * self.count], np.float32)",
        "beyond the bounds in each reset": _RESET
        + "super().reset(**kwargs)\n    return np.full(2, 101, np.float32), {}",
        "pixels of 255 in a space of 1": "observation_space = "
        "gym.spaces.Box(0, 1, (4, 4, 3), np.float32)\n"
        + (_SEEN + "np.full((4, 4, 3), 9 * self.count, np.float32)"),
        "no number, within bounds": _SEEN + "np.full(2, np.nan, np.float32)",
        "no number, without bounds": _WIDE + _SEEN + "np.full(2, np.nan, np.float32)",
        "a number that is none of them": "observation_space = gym.spaces.Discrete(5)\n"
        + _SEEN
        + "self.count",
        "one of several that is too large": "observation_space = gym.spaces.MultiDiscrete([3, 3])\n"
        + (_SEEN + "np.array([self.count, 0])"),
    },
    "observation-finite": {
        "infinite, without bounds": _WIDE
        + _SEEN
        + "np.array([self.at, np.inf if self.count > 4 else 0], np.float32)",
        "infinite in a dict": "far = gym.spaces.Box(0, np.inf, (1,), np.float32)\n"
        "observation_space = gym.spaces.Dict({'far': far})\n"
        + (_SEEN + "{'far': np.full(1, 9 if self.at > 0 else np.inf, np.float32)}"),
    },
}
_STEPS = {
    "rewards": {
        "a reward that is no number": _REWARD + "float('nan')",
        "a reward that is no number at the end": _REWARD
        + "np.float64(0) / 0 if self.count >= 12 else 0.0",
        "an infinite reward": _REWARD + "np.inf if self.count > 5 else 1.0",
        "a reward of minus infinity": _REWARD + "-np.inf if self.count > 5 else 1.0",
    },
    "info-types": {"an info that cannot cross": _INFO + "{'goal': {'who': lambda: 1}}"},
    "step-types": {
        "a reward in an array": _REWARD + "np.array(self.at)",
        "a reward as text": _REWARD + "'1.0'",
        "an end in an array": _LATE + "np.array([self.count >= 12])",
        "an end that is None": _LATE + "True if self.count >= 12 else None",
        "an end that is a number": _LATE + "int(self.count >= 12)",
    },
    "runs": {
        "infos that are a list": _INFO + "[1]",
        "infos that are None": _INFO + "None",
        "four things of a step": _STEP
        + "one, two, three, _, five = super().step(action)\n    return one, two, three, five",
        "a step that raises": _STEP + "raise RuntimeError('it broke')",
        "a step that raises late": _STEP + "assert self.count < 8, 'it broke'" + _STEPPED,
        "an action that it does not take": _STEP + "assert action < 2, 'unknown action'" + _STEPPED,
        "a discrete action taken for an array": _STEP + "action[0]" + _STEPPED,
    },
    "actions-ignored": {
        "actions that do nothing": "def move(self, action):\n"
        "    self.at += float(self.np_random.uniform())",
        "actions of an array that do nothing": "action_space = "
        "gym.spaces.Box(-1, 1, (3,), np.float32)\n"
        "def move(self, action):\n    self.at += 0.1",
    },
    "large-infos": {
        "a mebibyte of info": _INFO + "{'map': np.zeros(1 << 20, np.uint8)}",
        "a mebibyte of text": _INFO + "{'log': 'x' * (1 << 20)}",
    },
    "endless": {
        "no end": _SEEN + "np.zeros(2, np.float32)\n" + _LATE + "False\n"
        "def move(self, action):\n    self.at = float(self.np_random.uniform()) * int(action)"
    },
}
_RESETS = {
    "runs": {
        "a reset without info": _RESET + "super().reset(**kwargs)\n    return self.observation()",
        "a reset that takes no seed": "def reset(self):\n    return super().reset()",
        "a reset that takes no options": "def reset(self, seed=None):\n"
        "    return super().reset(seed=seed)",
        "a reset that wants options": "def reset(self, *, seed=None, options=None):\n"
        "    options['level']\n    "
        "return super().reset(seed=seed)",
        "a close that raises": "def close(self):\n    raise RuntimeError('twice')",
        "a second reset that raises": _RESET
        + "assert not hasattr(self, 'at'), 'only once'"
        + _RESULT,
        "a reset without a seed that raises": _RESET + "kwargs['seed'] + 1" + _RESULT,
    }
}
_SEEDS = {
    "seed-ignored": {
        "a seed that is ignored": "def __init__(self):\n"
        "    self.random = np.random.default_rng(3)\n"
        "def move(self, action):\n    self.at += self.random.normal() * int(action)",
        "a seed that is ignored at the reset": "def __init__(self):\n"
        "    self.random = np.random.default_rng(3)\n"
        + (_RESET + "super().reset(**kwargs)\n    self.at = float(self.random.normal())")
        + "\n    return self.observation(), {}",
        "a seed of 0 that is ignored": "random = np.random.default_rng(3)\n"
        "def reset(self, *, seed=None, options=None):\n    super().reset(seed=seed)\n"
        "    if seed:\n        self.random = np.random.default_rng(seed)\n"
        "    self.at = float(self.random.normal())\n    return self.observation(), {}",
        "a seed that is ignored below running statistics": "def __init__(self):\n"
        "    self.random = np.random.default_rng(3)\n"
        "def move(self, action):\n    self.at += self.random.normal() * int(action)",
        "a generator for resets without a seed": "random = np.random.default_rng(3)\n"
        "def reset(self, *, seed=None, options=None):\n    super().reset(seed=seed)\n"
        "    self.at = float((self.np_random if seed is not None else self.random).normal())\n"
        "    return self.observation(), {}\nlength = 100",
        "running statistics": "total, seen = 0.0, 0\n"
        + _SEEN.replace("return ", "")
        + "self.total, self.seen = self.total + self.at, self.seen + 1\n"
        "    return np.array([self.at - self.total / self.seen, self.count], np.float32)",
        "a curriculum": "episodes = 0\n"
        + _RESET
        + "self.episodes += 1\n    super().reset(**kwargs)\n"
        "    self.at *= self.episodes\n    return self.observation(), {}",
        "speed that a reset keeps": "speed = 0.0\ndef move(self, action):\n"
        "    self.speed += 0.1 * (int(action) - 0.5)\n"
        "    self.at += self.speed",
    },
    "seed-constant": {
        "one seed for all seeds": "def reset(self, *, seed=None, options=None):\n"
        "    return super().reset(seed=3)"
    },
    "seeding": {
        "numpy's global generator": "def move(self, action):\n"
        "    self.at += np.random.normal() * int(action)",
        "Python's global generator": _RESET
        + "super().reset(**kwargs)\n    self.at = random.random()\n"
        "    return self.observation(), {}",
        "Python's global generator without a seed": "def reset(self, *, seed=None, options=None):\n"
        "    super().reset(seed=seed)\n"
        "    self.at = self.at if seed is not None else random.random()\n"
        "    return self.observation(), {}",
        "a new generator each time": "def move(self, action):\n"
        "    self.at += np.random.default_rng().normal() * int(action)",
        "the time of day": "def move(self, action):\n    self.at += int(action) + time.time() % 1",
        "an identifier by lot": _REWARD + "uuid.uuid4().int % 1000 / 1000",
    },
    "seed-fixed": {
        "always the same without a seed": "def reset(self, *, seed=None, options=None):\n"
        "    return super().reset(seed=42 if seed is None else seed)\nlength = 100"
    },
    "workers": {
        "a global generator that is seeded": "def reset(self, *, seed=None, options=None):\n"
        "    super().reset(seed=seed)\n"
        "    if seed is not None:\n        np.random.seed(seed)\n"
        "    self.at = float(np.random.normal())\n    return self.observation(), {}\n"
        "def move(self, action):\n    self.at += np.random.normal() * int(action)",
        "a list that all share": "made = []\ndef __init__(self):\n    self.made.append(self)\n"
        + (_REWARD + "self.at + len(self.made)"),
    },
}
_LEFT = {
    "leaks-processes": {
        "a program in each reset": _RESET + "subprocess.Popen(['sleep', '3600'])" + _RESULT,
        "a fork in each reset": _RESET + "os.fork() or time.sleep(3600)" + _RESULT,
    },
    "leaks-threads": {
        "a thread in each reset": _RESET
        + "threading.Thread(target=threading.Event().wait, daemon=True).start()"
        + _RESULT,
        "a pool in each reset": "pools = []\n"
        + _RESET
        + "pool = concurrent.futures.ThreadPoolExecutor()\n    pool.submit(int)\n"
        "    self.pools.append(pool)" + _RESULT,
        "a thread in each step": _STEP
        + "threading.Thread(target=threading.Event().wait, daemon=True).start()"
        + _STEPPED,
    },
    "leaks-files": {
        "a file in each reset": "files = []\n"
        + _RESET
        + "self.files.append(tempfile.TemporaryFile())"
        + _RESULT,
        "a pipe in each reset": _RESET + "os.pipe()" + _RESULT,
        "sockets in each reset": "pairs = []\n"
        + _RESET
        + "self.pairs.append(socket.socketpair())"
        + _RESULT,
        "a file in each step": _STEP + "os.pipe()" + _STEPPED,
    },
    "leaks-memory": {
        "a list that grows in each step": "kept = []\n"
        + _STEP
        + "self.kept.append(np.ones(1 << 17))"
        + _STEPPED,
        "a list that grows": "kept = []\n"
        + _RESET
        + "self.kept.append(np.ones(1 << 18))"
        + _RESULT,
        "a cache that grows": "@functools.lru_cache(None)\ndef built(self, number):\n"
        "    return bytearray(1 << 21)\n"
        + _RESET
        + "Env.episodes = getattr(Env, 'episodes', 0) + 1\n"
        "    self.built(Env.episodes)[:] = b'x' * (1 << 21)" + _RESULT,
    },
}
_ENDS = {
    "survives": {
        "an exit": _STEP + "os._exit(3)",
        "a signal": _STEP + "os.kill(os.getpid(), 9)",
        "a step without an end": _STEP + "time.sleep(3600)",
        "a reset without an end": _RESET + "time.sleep(3600)",
    },
    "slow-steps": {"a step that takes long": _STEP + "time.sleep(0.06)" + _STEPPED},
    "slow-resets": {"a reset that takes long": _RESET + "time.sleep(0.3)" + _RESULT},
}
_RENDERS = {
    "render": {
        "no frame": _RENDER + "None",
        "a frame of floats": _RENDER + "np.zeros((8, 8, 3), np.float32)",
        "a frame with four channels": _RENDER + "np.zeros((8, 8, 4), np.uint8)",
        "a frame without channels": _RENDER + "np.zeros((8, 8), np.uint8)",
        "a frame with channels in front": _RENDER + "np.zeros((3, 8, 8), np.uint8)",
        "a frame for a text": "render_mode = 'ansi'",
        "a frame for a list": "render_mode = 'rgb_array_list'",
        "a rendering that raises": "def render(self):\n    raise ValueError('no display')",
        "a rendering that is not there": "def render(self):\n    raise NotImplementedError",
    },
    "render-fps": {
        "no rate of frames": "metadata = {'render_modes': ['rgb_array']}",
        "a rate that is a text": "metadata = {'render_fps': '25'}",
    },
}
_DENIED = {
    "a connection": (
        "denied-network",
        _RESET + "ctypes.CDLL(None).socket(2, 1, 0)" + _RESULT,
        ("source-native",),
    ),
    "a file of somebody else": (
        "denied-files",
        _RESET + "Path('..', '..', 'srv', 'walk').resolve().exists() or "
        "ctypes.CDLL(None).unlink(b'/srv' + b'/walk')" + _RESULT,
        ("source-native",),
    ),
    "a namespace": (
        "denied-kernel",
        _RESET + "ctypes.CDLL(None).unshare(0x10000000)" + _RESULT,
        ("source-native",),
    ),
}
_SOURCES = {
    "eval": ("source-dynamic", _REWARD + "eval('1.0')"),
    "a program": ("source-process", _REWARD + "float(os.system('true'))"),
    "a link without an end": ("source-network", "", "from urllib import request\n"),
    "a pickle": ("source-pickle", "", "import pickle\n"),
    "machine code": ("source-native", "", "import ctypes\n"),
    "the caller's home": ("source-outside", "home = '~/.ssh/id_rsa'"),
    "a character that nobody sees": ("source-hidden", "word = 'wa\u200blk'"),
    "an order that is turned around": ("source-hidden", "word = 'a\u202eb'"),
    "a long text of no words": ("source-obscure", f"word = '{'Zm9vYmFy' * 700}'"),
}
_MODULES = (
    *("concurrent.futures", "functools", "os", "random", "socket", "subprocess"),
    *("tempfile", "threading", "time", "uuid"),
)
_LOADING = {
    "no make_env": _fault("loading", "loads", files={"env.py": "import gymnasium\n"}),
    "nothing returned": _returned("loads", "None"),
    "a number returned": _returned("loads", "3"),
    "a class returned": _returned("loads", "Env"),
    "an empty dict": _returned("loads", "{}"),
    "spaces that differ": _returned(
        "loads",
        "gym.vector.SyncVectorEnv([Env, Other])",
        head="class Other(Env):\n    observation_space = gym.spaces.Discrete(2)\n",
    ),
    "one environment for all": Entry(
        group="vectors",
        told="workers",
        code="def make_env(n_envs=1, use_async_envs=False):\n    env = Env()\n"
        "    return gym.vector.SyncVectorEnv([lambda: env] * n_envs)\n",
    ),
    "fewer than asked for": Entry(
        group="vectors",
        told="num-envs",
        code="def make_env(n_envs=1, use_async_envs=False):\n"
        "    return gym.vector.SyncVectorEnv([Env])\n",
    ),
    "no arguments": Entry(
        group="vectors",
        told="num-envs",
        code="def make_env():\n    return gym.vector.SyncVectorEnv([Env])\n",
    ),
    "an argument of its own": Entry(
        group="loading",
        told="loads",
        code="def make_env(level, n_envs=1, use_async_envs=False):\n"
        "    return gym.vector.SyncVectorEnv([Env] * n_envs)\n",
    ),
    "a module that raises": _fault("loading", "loads", code="raise RuntimeError('no licence')\n"),
    "no such id": _returned("loads", "gym.make_vec('NoSuch-v0', n_envs)"),
    "a question": _fault("loading", "loads", head="name = input('who are you? ')\n"),
    "a file that is not there": _fault("loading", "loads", head="open('weights.bin')\n"),
    "bounds the wrong way round": _fault(
        "loading", "loads", "observation_space = gym.spaces.Box(np.zeros(2), np.full(1, 9))"
    ),
    "an undeclared package": _fault("loading", "imports", head="import not_to_be_had\n"),
    "an undeclared package, late": _fault(
        "loading", "imports", _RESET + "import not_to_be_had" + _RESULT, also=frozenset({"runs"})
    ),
    "a link as requirement": _fault(
        "loading", "requirements", files={"requirements.txt": "x @ https://example.com/x.whl\n"}
    ),
    "no requirement": _fault("loading", "requirements", files={"requirements.txt": "== 3 ==\n"}),
}
_VECTORS = {
    "a reward of the step that resets": _batch("autoreset", "rewards = rewards + 1.0"),
    "an end that comes late": _batch(
        "autoreset",
        "before, self.late = self.late, truncated\n"
        "        truncated = truncated & False if before is None else before",
    ),
    "no last observation": _batch(
        "autoreset", "infos = {k: v for k, v in infos.items() if 'final' not in k}", "SAME_STEP"
    ),
    "infos of three": _batch("infos", "infos = {'at': np.zeros(3), '_at': np.ones(3, bool)}"),
    "masks that are numbers": _batch("infos", "infos = {'at': np.zeros(2), '_at': np.ones(2)}"),
    "a mode that is not stated": Entry(
        group="vectors",
        told="autoreset-stated",
        code="class Batch(gym.vector.SyncVectorEnv):\n    def __init__(self, makers):\n"
        "        super().__init__(makers)\n        self.metadata = {'render_fps': 10}\n\n"
        "def make_env(n_envs=1, use_async_envs=False):\n    return Batch([Env] * n_envs)\n",
    ),
}
_FILES: dict[str, tuple[str, dict[str, str | bytes]]] = {
    "compiled Python": ("source-compiled", {"walking.pyc": _compiled()}),
    "another encoding": ("source-encoding", {"more.py": "# -*- coding: unicode_escape -*-\n"}),
    "a file too large to read": ("source-unparsed", {"more.py": "x = 1\n" * 50_000}),
    "an archive": ("source-unread", {"more.zip": _archive()}),
    "no Python": ("source-unread", {"more.py": "print 'hello'\n"}),
}
_SHORT = {"timeouts": dict.fromkeys(("call_s", "reset_s", "step_s"), 3.0)}
_PARTICULAR: dict[str, dict[str, Any]] = {
    "a close that raises": {
        "found": frozenset(),
        "why": "its processes are ended, whatever `close` does.",
    },
    "a seed that is ignored below running statistics": {
        "code": "def one():\n    return gym.wrappers.NormalizeReward(Env())\n"
        "def make_env(n_envs=1, use_async_envs=False):\n"
        "    return gym.vector.SyncVectorEnv([one] * n_envs)"
    },
    "no end": {"settings": {"episode_steps": 300}},
    "a step without an end": {"arguments": _SHORT},
    "a reset without an end": {"arguments": _SHORT},
    # what does not sleep takes less than half of that where ten tests share a core
    "a step that takes long": {"settings": {"slow_step_s": 0.05, "steps": 4}},
    "a reset that takes long": {"settings": {"slow_step_s": 0.05, "steps": 4}},
    "a program in each reset": {"also": frozenset({"source-process"})},
    "a fork in each reset": {"also": frozenset({"source-process"})},
    "sockets in each reset": {"also": frozenset({"source-network"})},
}


def _imports(env: str) -> str:
    used = (name for name in _MODULES if re.search(rf"(?<![.\w]){name}\.", env))
    return "".join(f"import {name}\n" for name in used)


def _all() -> dict[str, Entry]:
    """Each table with its group."""
    groups = {
        "observations": _OBSERVATIONS,
        "steps": _STEPS,
        "resets": _RESETS,
        "seeds": _SEEDS,
        "what is left": _LEFT,
        "ends and time": _ENDS,
        "rendering": _RENDERS,
    }
    found = {
        name: _fault(group, told, env, head=_imports(env), **_PARTICULAR.get(name, {}))
        for group, table in groups.items()
        for told, faults in table.items()
        for name, env in faults.items()
    }
    for name, (told, env, also) in _DENIED.items():
        head = "import ctypes\nfrom pathlib import Path\n"
        found[name] = _fault("what is denied", told, env, also=frozenset(also), head=head)
    for name, (told, env, *head) in _SOURCES.items():
        found[name] = _fault("sources", told, env, head="".join(head) or "import os\n")
    for name, (told, files) in _FILES.items():
        found[name] = _fault("sources", told, files=files)
    return {**found, **_LOADING, **_VECTORS}


FAULTS: dict[str, Entry] = _all()
