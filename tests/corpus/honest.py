"""Repositories in which nothing is wrong, each in a style of its own."""

from typing import Any

from tests.corpus.entries import Entry


def _env(body: str = "", code: str = "", **more: Any) -> Entry:
    return Entry(group="honest", env=body, code=code, **more)


def _vector(of: str, head: str = "") -> Entry:
    make = f"def make_env(n_envs=1, use_async_envs=False):\n    return {of}\n"
    return _env(code=f"{head}\n{make}")


def _known(name: str, **arguments: Any) -> Entry:
    make = f"lambda: gym.make({name!r}, **{arguments})"
    return _vector(f"gym.vector.SyncVectorEnv([{make}] * n_envs)")


def _mode(name: str, class_: str = "SyncVectorEnv") -> Entry:
    mode = f"autoreset_mode=gym.vector.AutoresetMode.{name}"
    return _vector(f"gym.vector.{class_}([Env] * n_envs, {mode})")


def _normalised(*wrappers: str) -> Entry:
    made = "Env()"
    for name in reversed(wrappers):
        made = f"gym.wrappers.{name}({made})"
    return _vector(f"gym.vector.SyncVectorEnv([lambda: {made}] * n_envs)")


_OWN_VECTOR = """
class Batch(gym.vector.VectorEnv):
    metadata = {"autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}

    def __init__(self, n):
        self.num_envs = n
        self.single_observation_space = Walk.observation_space
        self.single_action_space = Walk.action_space
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, n)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, n)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count, self.done = np.zeros(self.num_envs), np.zeros(self.num_envs, bool)
        self.at = self.np_random.uniform(-1, 1, self.num_envs)
        return self.seen(), {}

    def seen(self):
        return np.asfortranarray(np.stack([self.at, self.count], 1).astype(np.float32))

    def step(self, actions):
        moved = self.at + self.np_random.uniform(0, 1, self.num_envs) * (np.asarray(actions) - 1)
        begun = self.np_random.uniform(-1, 1, self.num_envs)
        self.at = np.where(self.done, begun, moved)
        self.count = np.where(self.done, 0, self.count + 1)
        rewards = np.where(self.done, 0.0, -np.abs(self.at))
        self.done = self.count >= 7 + np.arange(self.num_envs)
        return self.seen(), rewards, np.zeros(self.num_envs, bool), self.done.copy(), {}

    def call(self, name, *args, **kwargs):
        return (getattr(self, name, None),) * self.num_envs

def make_env(n_envs=1, use_async_envs=False):
    return Batch(n_envs)
"""
_WORDS = """
observation_space = gym.spaces.Text(20, charset="abcdefghijklmnopqrstuvwxyz ")
action_space = gym.spaces.Text(8, charset="abc")

def observation(self):
    return "say the word"

def move(self, action):
    self.at = 1.0 if action == "abracadabra" else 0.0
"""
_GOAL = """
observation_space = gym.spaces.Dict({
    "observation": gym.spaces.Box(-100, 100, (2,), np.float64),
    "achieved_goal": gym.spaces.Box(-100, 100, (1,), np.float64),
    "desired_goal": gym.spaces.Box(-100, 100, (1,), np.float64),
})
action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

def move(self, action):
    self.at += float(action[0])

def observation(self):
    at = np.array([self.at, self.count], np.float64)
    return {"observation": at, "achieved_goal": at[:1], "desired_goal": np.array([3.0])}

def compute_reward(self, achieved_goal, desired_goal, info):
    return -float(np.linalg.norm(achieved_goal - desired_goal))

def reward(self):
    seen = self.observation()
    return self.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})

def info(self):
    return {"is_success": self.reward() > -0.5}
"""
_PIXELS = """
observation_space = gym.spaces.Box(0, 255, (48, 64, 3), np.uint8)

def observation(self):
    frame = np.zeros((48, 64, 3), np.uint8)
    frame[:, int(self.at) % 64] = 255
    frame[self.count % 48] = int(abs(self.at) * 9) % 256
    return frame

def render(self):
    return self.observation()
"""
_CAMERAS = """
observation_space = gym.spaces.Dict({
    "pixels": gym.spaces.Dict({"top": gym.spaces.Box(0, 255, (24, 32, 3), np.uint8)}),
    "agent_pos": gym.spaces.Box(-100, 100, (2,), np.float64),
})
task = task_description = "walk to the right"
_max_episode_steps = 12

def observation(self):
    top = np.full((24, 32, 3), int(abs(self.at)) % 256, np.uint8)
    return {"pixels": {"top": top}, "agent_pos": np.array([self.at, self.count])}

def info(self):
    return {"is_success": bool(self.at > 3)}
"""
_GENERATOR = """
def reset(self, *, seed=None, options=None):
    if seed is not None or not hasattr(self, "random"):
        self.random = np.random.default_rng(seed)
    self.at, self.count = float(self.random.normal()), 0
    return self.observation(), {}

def move(self, action):
    self.at += float(self.random.normal()) * (int(action) - 1)
"""
_GIVEN_SEED = """
def reset(self, *, seed=None, options=None):
    super().reset(seed=seed)
    self.random = random.Random(int(self.np_random.integers(1 << 31)))
    self.at, self.count = self.random.random(), 0
    return self.observation(), {}

def move(self, action):
    self.at += self.random.random() * (int(action) - 1)
"""
_PROGRAM = """
def __init__(self):
    self.program = subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)

def reward(self):
    self.program.stdin.write(b"%d\\n" % self.count)
    self.program.stdin.flush()
    return float(self.program.stdout.readline())

def close(self):
    self.program.stdin.close()
    self.program.wait()
"""
_THREADS = """
def reset(self, **kwargs):
    found = []
    thread = threading.Thread(target=lambda: found.append(1))
    thread.start()
    thread.join()
    return super().reset(**kwargs)
"""
_POOL = """
def __init__(self):
    self.pool = concurrent.futures.ThreadPoolExecutor(2)

def reward(self):
    return sum(self.pool.map(float, [1, 2, self.count]))

def close(self):
    self.pool.shutdown()
"""
_CACHED = """
def reset(self, **kwargs):
    path = pathlib.Path(tempfile.gettempdir(), "map.npy")
    if not path.exists():
        with tempfile.TemporaryDirectory() as own:  # several processes may be at it
            np.save(pathlib.Path(own, path.name), np.arange(9.0))
            pathlib.Path(own, path.name).replace(path)
    self.map = np.load(path)
    return super().reset(**kwargs)

def reward(self):
    return float(self.map[self.count % 9])
"""
_LAZY = """
model = None

def reset(self, **kwargs):
    if Env.model is None:
        Env.model = np.full((64, 64), 0.5)
    return super().reset(**kwargs)

def reward(self):
    return float(self.model[self.count % 64].sum())
"""
_LARGE = """
def __init__(self):
    self.table = np.ones(4 << 20)

def reset(self, **kwargs):
    self.copy = self.table.copy()
    return super().reset(**kwargs)
"""
_GRAPH = """
observation_space = gym.spaces.Graph(gym.spaces.Box(-100, 100, (2,), np.float32), None)

def observation(self):
    nodes = np.full((1 + self.count % 3, 2), self.at, np.float32)
    return gym.spaces.GraphInstance(nodes, None, None)
"""
_SEQUENCE = """
observation_space = gym.spaces.Sequence(gym.spaces.Box(-100, 100, (1,), np.float32))

def observation(self):
    return tuple(np.full(1, self.at, np.float32) for _ in range(1 + self.count % 3))
"""
_MODES = """
metadata = {"render_modes": ["rgb_array", "ansi", "rgb_array_list"], "render_fps": 5}

def __init__(self, mode):
    self.render_mode = mode

def render(self):
    frame = np.zeros((8, 8, 3), np.uint8)
    return {"ansi": "o", "rgb_array": frame, "rgb_array_list": [frame]}[self.render_mode]
"""
_WORDLESS = """
import gymnasium

class Words(gymnasium.spaces.Space):
    shape, dtype = None, None
"""
_OWN_SPACE = """
observation_space = gym.spaces.Dict({"at": Walk.observation_space, "word": Words()})

def observation(self):
    return {"at": super().observation(), "word": "left"}
"""
_WITH_MODE = """
def make_env(n_envs=1, use_async_envs=False, render_mode="rgb_array"):
    return gym.vector.SyncVectorEnv([lambda: Env(render_mode)] * n_envs)
"""
_SUITES = """
class Far(Env):
    length = 20

def make_env(n_envs=1, use_async_envs=False):
    makers = {0: Env, 1: Far}
    both = {n: gym.vector.SyncVectorEnv([one] * n_envs) for n, one in makers.items()}
    return {"near": {0: both[0]}, "far": {"late": both[1]}}
"""
_MODULES = {
    "walking/__init__.py": "from .steps import SIZES\n",
    "walking/steps.py": "from .sizes import SMALL\nSIZES = (SMALL, 2 * SMALL)\n",
    "walking/sizes.py": "SMALL = 0.25\n",
}
_POSTPONED = """
@dataclasses.dataclass
class Config:
    length: int = 12
    names: list[str] | None = None

def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Config | None = None):
    config = Config()

    def one():
        env = Env()
        env.length = config.length
        return env

    return gym.vector.SyncVectorEnv([one] * n_envs)
"""
HONEST: dict[str, Entry] = {
    "a walk": _env(),
    "CartPole": _known("CartPole-v1"),
    "MountainCar": _known("MountainCar-v0", max_episode_steps=40),
    "Pendulum": _known("Pendulum-v1", max_episode_steps=40),
    "FrozenLake, slippery": _known("FrozenLake-v1"),
    "Blackjack, a tuple": _known("Blackjack-v1"),
    "Taxi": _known("Taxi-v4", max_episode_steps=40),
    "CliffWalking": _known("CliffWalking-v1", max_episode_steps=40),
    "Gymnasium's own batch": _vector(
        'gym.make_vec("CartPole-v1", n_envs, vectorization_mode="vector_entry_point")'
    ),
    "a batch in NumPy": _env(code=_OWN_VECTOR),
    "several processes": _vector("gym.vector.AsyncVectorEnv([Env] * n_envs)"),
    "reset in the same step": _mode("SAME_STEP"),
    "reset in the same step, in processes": _mode("SAME_STEP", "AsyncVectorEnv"),
    "reset by its user": _mode("DISABLED"),
    "a dict": _env(_GOAL),
    "a tuple": _env("""
        observation_space = gym.spaces.Tuple((Walk.observation_space, gym.spaces.Discrete(100)))

        def observation(self):
            return super().observation(), self.count
    """),
    "cameras, as LeRobot wants them": _env(_CAMERAS),
    "pixels": _env(_PIXELS),
    "suites and tasks": _env(code=_SUITES),
    "words": _env(_WORDS),
    "graphs": _env(_GRAPH),
    "sequences": _env(_SEQUENCE),
    "several discrete actions": _env("""
        action_space = gym.spaces.MultiDiscrete([3, 2])

        def move(self, action):
            super().move(action[0] * action[1])
    """),
    "binary actions": _env("""
        action_space = gym.spaces.MultiBinary(4)

        def move(self, action):
            self.at += float(np.sum(action)) - 2
    """),
    "actions in a dict": _env("""
        action_space = gym.spaces.Dict(
            {"go": gym.spaces.Box(-1, 1, (2,), np.float32), "jump": gym.spaces.Discrete(2)}
        )

        def move(self, action):
            self.at += float(action["go"].sum()) + float(action["jump"])
    """),
    "a count from one": _env("""
        observation_space = gym.spaces.Discrete(40, start=1)

        def observation(self):
            return 1 + self.count + (10 if self.at > 0 else 0)
    """),
    "no bounds": _env("observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)"),
    "64 bits": _env("""
        observation_space = gym.spaces.Box(-100, 100, (2,), np.float64)

        def observation(self):
            return np.array([self.at, self.count])
    """),
    "an array that is not contiguous": _env("""
        observation_space = gym.spaces.Box(-100, 100, (2, 3), np.float32)

        def observation(self):
            return np.array([[self.at, self.count]] * 3, np.float32).T
    """),
    "one buffer for all observations": _env("""
        def observation(self):
            self.buffer = getattr(self, "buffer", np.zeros(2, np.float32))
            self.buffer[:] = self.at, self.count
            return self.buffer
    """),
    "numpy's own scalars": _env("""
        def reward(self):
            return np.float32(self.at)

        def is_late(self):
            return np.bool_(self.count >= 9)
    """),
    "whole rewards": _env("""
        def reward(self):
            return int(self.at > 0)
    """),
    "infos that vary": _env("""
        def info(self):
            return {"even": self.count, "text": "a"} if self.count % 2 == 0 else {"odd": [1, 2]}
    """),
    "a small picture in the infos": _env("""
        def info(self):
            return {"picture": np.zeros((96, 96, 3), np.uint8)}
    """),
    "a generator of its own": _env(_GENERATOR),
    "a generator seeded by np_random": _env(_GIVEN_SEED, head="import random\n"),
    "nothing drawn by lot": _env("""
        def reset(self, **kwargs):
            super().reset(**kwargs)
            self.at = 0.0
            return self.observation(), {}

        def move(self, action):
            self.at += int(action) - 1
    """),
    "one step": _env(
        "length = 1\n\ndef move(self, action):\n    assert not self.count, 'it has ended'\n"
        "    super().move(action)"
    ),
    "a time limit": _vector(
        "gym.vector.SyncVectorEnv([lambda: gym.wrappers.TimeLimit(Env(), 8)] * n_envs)"
    ),
    "statistics of episodes": _vector(
        "gym.vector.SyncVectorEnv([lambda: gym.wrappers.RecordEpisodeStatistics(Env())] * n_envs)"
    ),
    "statistics of a batch": _vector(
        "gym.wrappers.vector.RecordEpisodeStatistics(gym.vector.SyncVectorEnv([Env] * n_envs))"
    ),
    "stacked frames": _vector(
        "gym.vector.SyncVectorEnv([lambda: gym.wrappers.FrameStackObservation(Env(), 3)] * n_envs)"
    ),
    "an id of its own": _vector(
        'gym.make_vec("corpus/Walk-v0", n_envs)',
        'gym.register("corpus/Walk-v0", entry_point=Env, max_episode_steps=9)',
    ),
    "several modes of rendering": _env(_MODES, _WITH_MODE),
    "text as rendering": _env("""
        metadata = {"render_modes": ["ansi"]}
        render_mode = "ansi"

        def render(self):
            return "." * self.count + "o"
    """),
    "a space of its own": _env(_OWN_SPACE, head=_WORDLESS),
    "no rendering": _env("metadata, render_mode = {}, None"),
    "modules of a package": _env(
        "length = int(48 * SIZES[0])", head="from walking import SIZES\n", files=_MODULES
    ),
    "data beside it": _env(
        'length = json.loads((pathlib.Path(__file__).parent / "data" / "walk.json").read_text())',
        head="import json\nimport pathlib\n",
        files={"data/walk.json": "11"},
    ),
    "postponed annotations": _env(
        code=_POSTPONED, head="from __future__ import annotations\nimport dataclasses\n"
    ),
    "a program that is closed": _env(_PROGRAM, head="import subprocess\n"),
    "threads that are joined": _env(_THREADS, head="import threading\n"),
    "a pool that is shut down": _env(_POOL, head="import concurrent.futures\n"),
    "a file that is kept": _env(_CACHED, head="import pathlib\nimport tempfile\n"),
    "a model loaded late": _env(_LAZY),
    "large, and no larger": _env(_LARGE),
    "warnings and logs": _env(
        """
        def reset(self, **kwargs):
            warnings.warn("be careful")
            logging.getLogger("walk").warning("a new episode")
            print("reset")
            return super().reset(**kwargs)
        """,
        head="import logging\nimport warnings\n",
    ),
    "an event loop": _env(
        """
        def reward(self):
            async def found():
                await asyncio.sleep(0)
                return float(self.count)

            return asyncio.run(found())
        """,
        head="import asyncio\n",
    ),
    "a database in memory": _env(
        """
        def __init__(self):
            self.base = sqlite3.connect(":memory:")

        def reward(self):
            return float(self.base.execute("select ? * 2", (self.count,)).fetchone()[0])
        """,
        head="import sqlite3\n",
    ),
    "Gymnasium's running statistics": _normalised("NormalizeObservation"),
    "running statistics of rewards": _normalised("NormalizeReward"),
    "running statistics around others": _normalised("NormalizeReward", "NormalizeObservation"),
    "an optional package": _env(head="try:\n import cupy\nexcept ImportError:\n cupy = None\n"),
}
