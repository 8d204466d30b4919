"""What LeRobot's pages do, with LeRobot's own functions after ``install()``; prints findings.
To be run in an interpreter that has LeRobot, by ``kit.run``."""

import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import fields
from inspect import signature
from typing import Any

import numpy as np
import torch
from gymnasium.vector import SyncVectorEnv
from lerobot.configs import parser
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs import utils
from lerobot.envs.configs import EnvConfig, IsaaclabArenaEnv, LiberoEnv
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

import envhub_sandbox.integrations.lerobot as ours
from envhub_sandbox import make_env as sandboxed
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.integrations import lerobot_eval
from envhub_sandbox.integrations.lerobot.config import SpareSuites

FOUND: dict[str, Any] = {}
COMMITS: dict[str, str] = json.loads(sys.argv[1])


def refused(*arguments: Any, **options: Any) -> list[str]:
    """Which of the builtin errors that LeRobot raises a call fails with."""
    theirs = (AttributeError, ImportError, OSError, RuntimeError, ValueError)
    try:
        make_env(*arguments, **options)
    except theirs as error:
        return [kind.__name__ for kind in theirs if isinstance(error, kind)]
    return []


def shape(envs: Any) -> dict[str, list[Any]]:
    found = {suite: list(tasks) for suite, tasks in envs.items()}
    envs.close()
    return found


def loads() -> None:
    """Every form of a reference, and every kind of result."""
    for name, reference in {
        "branch": "robots/cartpole@main",
        "tag": "robots/cartpole@v1.0",
        "commit": f"robots/cartpole@{COMMITS['cartpole'][:12]}",
        "file": "robots/reach@v1.0:envs/reach_task.py",
        "space": "robots/uploaded",
        "suites": "robots/suites",
        "single": "robots/single",
    }.items():
        FOUND[name] = shape(make_env(reference, n_envs=1, trust_remote_code=True))
    FOUND["no consent"] = shape(make_env("robots/cartpole"))
    FOUND["async"] = shape(make_env("robots/cartpole", n_envs=8, use_async_envs=True))


def plays() -> None:
    """The page's episode, on a vector environment."""
    envs = make_env("robots/cartpole", n_envs=4, trust_remote_code=True)
    env = envs[next(iter(envs))][0]
    env.reset()
    total, done = np.zeros(env.num_envs), np.zeros(env.num_envs, bool)
    while not done.any():
        _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        total += reward
        done = terminated | truncated
    env.close()
    FOUND["played"] = bool((total > 0).all())


def one_by_one() -> None:
    """LeIsaac's way, and that of the unitree robot."""
    env = make_env("robots/reach", trust_remote_code=True)["hub_env"][0].envs[0].unwrapped
    if hasattr(env, "initialize"):
        env.initialize()
    actions = env.action_space  # a copy each time, which seeds no other
    actions.seed(0)
    env.reset(seed=0)  # with other actions it might reach its goal, and end sooner
    for _ in range(9):
        action = torch.tensor(actions.sample())
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    FOUND["one"] = [env.ready, hasattr(env, "initialise"), env.steps]
    env.close()


def configured() -> None:
    """A configuration that is the Hub's already, and what a repository reads of it."""
    cfg = IsaaclabArenaEnv(hub_path="robots/configured", environment="open the door")
    envs = make_env(cfg, n_envs=2)
    env = next(iter(envs.values()))[0]
    env.reset(seed=0)
    FOUND["configured"] = list(env.call("task"))
    envs.close()


def walked_through() -> None:
    """Pendulum with ``agent_pos``: what a policy is given of it."""
    envs = make_env("robots/pendulum", n_envs=2)
    env = next(iter(envs.values()))[0]
    observation, _ = env.reset(seed=0)
    given = preprocess_observation(observation)
    FOUND["pendulum"] = {name: list(tensor.shape) for name, tensor in given.items()}
    envs.close()


def described() -> None:
    """Our own type: what a policy is built from, before there is an environment."""
    cfg = EnvConfig.get_choice_class("envhub_sandbox")(repo="robots/cameras", task="0")
    features = env_to_policy_features(cfg)
    FOUND["features"] = {name: [one.type.value, *one.shape] for name, one in features.items()}
    FOUND["pinned"] = f"robots/cameras@{COMMITS['cameras']}" in str(cfg.repo)
    chosen = ours.SandboxedEnvConfig(repo="robots/suites", suite="near", task="1")
    envs = make_env(chosen, n_envs=2)
    FOUND["chosen"] = [list(env.get_attr("task")) for env in envs["near"].values()]
    FOUND["chosen shape"] = shape(envs)


def processed() -> None:
    """What a policy is given of observations in the forms of LIBERO and of Isaac Lab Arena: what
    LeRobot's own configurations of these make of them, in the shapes of the features."""
    arena = {"state_keys": "robot_joint_pos,fingers", "camera_keys": "robot_pov_cam_rgb"}
    own = {name: LiberoEnv().get_env_processors()[0] for name in ("libero", "declared")}
    own["arena"] = IsaaclabArenaEnv(**arena).get_env_processors()[0]
    for name, theirs in own.items():
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            chosen = arena if name == "arena" else {}
            cfg = ours.SandboxedEnvConfig(repo=f"robots/{name}", **chosen)
        envs = make_env(cfg, n_envs=2)
        observation, _ = envs.env.reset(seed=[3, 4])
        passed_on = preprocess_observation(observation)
        seen, expected = (
            {key: it for key, it in made(dict(passed_on)).items() if key.startswith("observation")}
            for made in (cfg.get_env_processors()[0], theirs)
        )
        if name == "declared":
            expected["observation.images.wrist"] = expected.pop("observation.images.image2")
        features = env_to_policy_features(cfg)
        features.pop("action")
        FOUND[name] = [
            seen.keys() == expected.keys() and all(seen[k].equal(expected[k]) for k in seen),
            {key: list(seen[key].shape[1:]) for key in features if key in seen}
            == {key: list(one.shape) for key, one in features.items()},
            sorted(features),
            ["not see scene of" in str(one.message) for one in warned],
        ]
        envs.close()
    try:
        ours.SandboxedEnvConfig(repo="robots/misdeclared")
    except ValueError as error:
        FOUND["misdeclared"] = "rename_observations_processor" in str(error)


def merged() -> None:
    """What is given of features, beside what the spaces say."""
    names = {"agent_pos": "observation.state.arm"}
    cfg = ours.SandboxedEnvConfig(repo="robots/reach", features_map=names)
    FOUND["renamed"] = sorted(env_to_policy_features(cfg))
    further = PolicyFeature(FeatureType.STATE, (9,))
    try:
        ours.SandboxedEnvConfig(repo="robots/reach", features={"touch": further})
    except ValueError as error:
        FOUND["unnamed"] = "--env.features_map=" in str(error)
    touch = {"features": {"touch": further}, "features_map": {"touch": "observation.touch"}}
    cfg = ours.SandboxedEnvConfig(repo="robots/reach", **touch)
    FOUND["further"] = sorted(env_to_policy_features(cfg))
    try:
        ours.SandboxedEnvConfig(repo="robots/reach", features_map={"agent_psos": "observation.a"})
    except ValueError as error:
        FOUND["misspelt feature"] = "agent_pos" in str(error)


def fails() -> None:
    for name in ("nothing", "missing", "wrong"):
        FOUND[name] = refused(f"robots/{name}", trust_remote_code=True)
    FOUND["no repository"] = refused("robots/nowhere")
    try:
        ours.install(polcy={})
    except TypeError as error:
        FOUND["option"] = "polcy" in str(error)
    try:
        ours.SandboxedEnvConfig(repo="robots/cartpole", endpoint="http://me:secret@127.0.0.1:9")
    except EnvHubError as error:
        FOUND["login"] = "secret" not in str(error)
    FOUND["cures"] = [
        said(lambda: ours.SandboxedEnvConfig(repo="robots/missing"), "--env.dependencies='{"),
        said(
            lambda: ours.SandboxedEnvConfig(repo="robots/reach", policy={"profile": "lax"}),
            "--env.policy: profile is 'lax'",
        ),
        said(lambda: sandboxed("robots/missing"), "dependencies={'extra'"),
    ]


def said(make: Callable[[], object], words: str) -> bool:
    """Whether what is raised says this, and no other spelling of an option."""
    try:
        make()
    except EnvHubError as error:
        return words in str(error) and (words.startswith("--") == ("--env." in str(error)))
    return False


def said_once() -> None:
    """What a command that cannot begin prints: one line, with the cure, and nothing of draccus."""
    command = ["lerobot-eval", "--policy.type=act", "--env.type=envhub_sandbox"]
    lines = []
    for words in (
        (),
        ("--env.repo=robots/suites", "--env.suite=nera"),
        ("--env.repo=robots/reach", '--env.policy={"profile": "lax"}'),
    ):
        try:
            taken(*command, *words)
        except SystemExit as error:
            lines.append(str(error.code))
    FOUND["said once"] = [
        len(line.splitlines()) == 1 and cure in line
        for line, cure in zip(
            lines,
            ("--env.repo=org/repo@<commit>", "['near'][0], ['near'][1]", "--env.policy: profile"),
            strict=True,
        )
    ]


def freezes() -> None:
    """Sub-environments that count their resets, beside the same in LeRobot's own wrapper."""
    wrapper = getattr(utils, "FreezeAfterEpisodeEnd", None)
    if wrapper is None:  # before 0.6
        FOUND["freezes"] = True
        return
    names: dict[str, Any] = {}
    exec(sys.argv[4], names)
    os.environ.pop("REACHED")
    lengths = (2, 5, 3)
    theirs = SyncVectorEnv([lambda: wrapper(names["Reach"]())] * len(lengths))
    envs = make_env("robots/counting", n_envs=len(lengths))
    ours = envs["hub_env"][0]
    for env in (theirs, ours):
        env.set_attr("_max_episode_steps", list(lengths))
    same = []
    theirs.action_space.seed(0)  # of which none comes to its goal, which would end it sooner
    for rollout in range(2):
        new = {utils.NEW_ROLLOUT_OPTION: True}
        pairs = [env.reset(seed=rollout, options=dict(new)) for env in (theirs, ours)]
        for _ in range(9):
            same.append(alike(*pairs))
            actions = theirs.action_space.sample()
            pairs = [env.step(actions) for env in (theirs, ours)]
            same.append(alike(theirs.call("render"), ours.call("render")))
    steps = [env.get_attr("steps") for env in (theirs, ours)]
    resets = [env.get_attr("resets") for env in (theirs, ours)]
    FOUND["freezes"] = all(same) and [*steps, *resets] == [lengths, lengths, (2, 2, 2), (2, 2, 2)]
    theirs.close()
    envs.close()


def alike(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return list(one) == list(other) and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    return one.dtype == other.dtype and np.array_equal(one, other)


def options() -> None:
    """What ``make_env`` takes and a configuration does not."""
    given = {item.name for item in fields(ours.SandboxedEnvConfig)}
    FOUND["not options"] = sorted(set(signature(sandboxed).parameters) - given)


def commands() -> None:
    """The lines of our own pages: what LeRobot's parser makes of each, and that it looks at all."""
    lines: list[list[str]] = json.loads(sys.argv[2])
    FOUND["commands"] = [taken(*line) for line in lines]
    program, *words = lines[0]
    try:
        taken(program, *words, "--env.rpeo=robots/reach")
    except SystemExit:
        FOUND["misspelt"] = "refused"


def taken(program: str, *words: str) -> list[str | None]:
    """What is played, and by what kind of policy, as that program of LeRobot's understands it."""
    if program == "lerobot-eval-sandboxed":
        options, words = lerobot_eval.split_eval_arguments([*words])
        ours.install(**options)
    made: list[Any] = []
    kind = TrainPipelineConfig if program == "lerobot-train" else EvalPipelineConfig
    arguments, sys.argv = sys.argv, [program, *words]
    try:
        parser.wrap()(annotated(made.append, kind))()
    finally:
        sys.argv = arguments
    [cfg] = made
    return [type(cfg.env).__name__, getattr(cfg.env, "repo", None), cfg.policy.type]


def annotated(function: Any, kind: type) -> Any:
    """As LeRobot's ``main`` is: by its annotation the parser knows what to make."""

    def main(cfg: Any) -> None:
        function(cfg)

    main.__annotations__ = {"cfg": kind}
    return main


def written() -> None:
    """The block of Python on our own page."""
    names: dict[str, Any] = {}
    exec(sys.argv[3], names)
    FOUND["written"] = shape(names["envs"])


def waits() -> None:
    """What answered for its spaces is used once, for the same request, and is closed in the end."""
    kept = SpareSuites(0.02)
    first, second = (make_env("robots/cartpole") for _ in range(2))
    kept.put("a", first)
    closed = eventually(lambda: first["hub_env"][0].closed)
    forever = SpareSuites(3600.0)
    forever.put("a", second)
    taken = forever.take("a") is second and forever.take("a") is None
    FOUND["waits"] = [closed, taken, second["hub_env"][0].closed]
    second.close()


def eventually(holds: Any) -> bool:
    deadline = time.monotonic() + 60
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.01)
    return bool(holds())


def control() -> None:
    """What LeRobot does without ``install``: the code runs here."""
    FOUND["control refused"] = refused("robots/reach")
    envs = make_env("robots/reach", trust_remote_code=True)
    FOUND["control executed here"] = os.environ.pop("REACHED", None) is not None
    envs["hub_env"][0].close()


if __name__ == "__main__":
    control()
    ours.install(timeouts={"startup_s": 250})
    for part in (
        loads,
        plays,
        one_by_one,
        configured,
        walked_through,
        described,
        options,
        waits,
        freezes,
        fails,
        merged,
        *((processed, commands, said_once, written) if ours.config.ASKS_CONFIGS else ()),
    ):
        part()
    FOUND["plugin"] = __import__("lerobot_env_envhub_sandbox").SandboxedEnvConfig.__name__
    FOUND["executed here"] = "REACHED" in os.environ
    print(json.dumps(FOUND))
