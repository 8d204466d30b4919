"""Chooses LeRobot's processor steps for an environment, and the features that its policies see.

This follows ``preprocess_observation`` of ``lerobot.envs.utils``, which chooses and names the parts
of an observation, and the steps of ``lerobot.processor.env_processor`` that may come after it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import prod
from typing import Any, NamedTuple

from gymnasium import Space
from gymnasium.spaces import Box, Dict
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.pipeline import ProcessorStepRegistry
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES, OBS_STATE, OBS_STR

DECLARED = "env_preprocessor"
"""The key in an environment's metadata by which a repository names processor steps."""
LIBERO, ARENA = "libero_processor", "isaaclab_arena_processor"
RENAME = "rename_observations_processor"
_FIELDS: dict[str, dict[str, type[Any]]] = {
    LIBERO: {},
    ARENA: {"state_keys": list, "camera_keys": list},
    RENAME: {"rename_map": dict},
}
"""The steps that a repository may name, as LeRobot registers them, and their fields."""
_NAMED = {
    "agent_pos": (OBS_STATE, FeatureType.STATE),
    "environment_state": (OBS_ENV_STATE, FeatureType.ENV),
}
_NESTED = ("pixels", "robot_state", "policy", "camera_obs")
_LIBERO_STATE = {("eef", "pos"): 3, ("eef", "quat"): 4, ("gripper", "qpos"): 2}
_LIBERO_SIZE = 8


class Feature(NamedTuple):
    """A feature for a policy: its name in LeRobot, and its type.
    ``source``: the key of the observation that it comes from.
    """

    policy_key: str
    kind: FeatureType
    shape: tuple[int, ...]
    source: str


@dataclass(frozen=True)
class Step:
    """A processor step of LeRobot, by its registered name."""

    name: str
    config: dict[str, Any] = field(default_factory=dict)


def processors(steps: list[Step]) -> Any:
    """Make LeRobot's pipeline of these steps."""
    return PolicyProcessorPipeline(
        steps=[ProcessorStepRegistry.get(step.name)(**step.config) for step in steps]
    )


def steps_for(
    observations: Space[Any], metadata: Mapping[str, Any], keys: Mapping[str, str | None]
) -> list[Step]:
    """Return the steps that the repository names, else LeRobot's for observations of this form.
    ``metadata``: the environment's metadata. Trust: input from the worker.
    ``keys``: the caller's ``state_keys`` and ``camera_keys``, as IsaaclabArenaEnv takes them.
    Raises ``ValueError``: the repository names a step that is not permitted, or configures it
    wrongly.
    """
    if metadata.get(DECLARED) is not None:
        return [*_declared(metadata[DECLARED])]
    if not isinstance(observations, Dict):
        return []
    spaces = observations.spaces
    if all(_is_vector(_inner(spaces, path), n) for path, n in _LIBERO_STATE.items()):
        return [Step(LIBERO)]
    states, cameras = ({**_boxes(spaces.get(key))} for key in ("policy", "camera_obs"))
    if not states and not cameras:
        return []
    there = {"state_keys": [*states], "camera_keys": [*cameras]}
    chosen = {name: _split(text) for name, text in keys.items() if text is not None}
    return [Step(ARENA, {name: tuple(chosen.get(name, own)) for name, own in there.items()})]


def _declared(declared: object) -> Iterator[Step]:
    """Read declared steps, data in the form of LeRobot's own files; imports nothing by name."""
    steps = declared.get("steps") if isinstance(declared, dict) else declared
    for step in steps if isinstance(steps, (list, tuple)) else [steps]:
        name = step.get("registry_name") if isinstance(step, dict) else None
        config = step.get("config") or {} if isinstance(step, dict) else {}
        if (
            type(name) is not str
            or name not in _FIELDS
            or not _is_configured(config, _FIELDS[name])
        ):
            raise ValueError(
                f"metadata[{DECLARED!r}] has {step!r:.200}; it takes steps such as "
                f"{{'registry_name': {RENAME!r}, 'config': {{'rename_map': {{...}}}}}}, of "
                f"{', '.join(_FIELDS)}"
            )
        tuples = {key: tuple(v) if isinstance(v, list) else v for key, v in config.items()}
        yield Step(name, tuples)


def _is_configured(config: object, kinds: Mapping[str, type[Any]]) -> bool:
    """Whether a configuration has exactly these fields, of these types, and only texts in them."""
    if not isinstance(config, dict) or config.keys() != kinds.keys():
        return False
    for key, value in config.items():
        texts = [*value, *value.values()] if isinstance(value, dict) else value
        if not isinstance(value, kinds[key]) or not all(type(text) is str for text in texts):
            return False
    return True


def features_of(
    observations: Space[Any], actions: Space[Any], steps: list[Step], *, others: bool
) -> dict[str, Feature]:
    """Return the features by key of the observation, or by LeRobot's own name for one of several
    cameras.

    Leaves out observations that LeRobot does not make a tensor of, and actions that are no vector.
    ``others``: whether this LeRobot passes on vectors with other names.
    """
    inner = observations.spaces if isinstance(observations, Dict) else {}
    seen = {key: item for name in inner for key, item in _passed_on(name, inner[name], others)}
    for step in steps:
        if step.name == LIBERO:
            seen["robot_state"] = Feature(
                OBS_STATE, FeatureType.STATE, (_LIBERO_SIZE,), "robot_state"
            )
        elif step.name == ARENA:
            seen = dict(_arena(inner, step.config))
        else:
            names = step.config["rename_map"]
            seen = {
                key: item._replace(policy_key=names.get(item.policy_key, item.policy_key))
                for key, item in seen.items()
            }
    if isinstance(actions, Box) and len(actions.shape) == 1:
        seen[ACTION] = Feature(ACTION, FeatureType.ACTION, actions.shape, "")
    return seen


def left_out(observations: Space[Any], seen: Mapping[str, Feature]) -> list[str]:
    """Return the keys of an observation that no policy sees."""
    if not isinstance(observations, Dict):
        return [f"the {type(observations).__name__}"]
    sources = {item.source for item in seen.values()}
    return [name for name in observations.spaces if name not in sources]


def _passed_on(name: str, space: Space[Any], others: bool) -> Iterator[tuple[str, Feature]]:
    """Yield the features that ``preprocess_observation`` makes of one key."""
    if name == "pixels":
        # one camera, or several by name; each has the shape (height, width, channels)
        if isinstance(space, Dict):
            yield from _cameras(space, space.spaces, "pixels")
        elif isinstance(space, Box) and len(space.shape) == 3:
            yield "pixels", Feature(OBS_IMAGE, FeatureType.VISUAL, space.shape, "pixels")
    elif name in _NAMED and isinstance(space, Box):
        yield name, Feature(*_NAMED[name], space.shape, name)
    elif others and name not in _NESTED and isinstance(space, Box) and len(space.shape) == 1:
        yield name, Feature(f"{OBS_STR}.{name}", FeatureType.STATE, space.shape, name)


def _cameras(space: Any, names: Any, source: str) -> Iterator[tuple[str, Feature]]:
    for name, camera in _boxes(space).items():
        key = f"{OBS_IMAGES}.{name}"
        if name in names and len(camera.shape) == 3:
            yield key, Feature(key, FeatureType.VISUAL, camera.shape, source)


def _arena(inner: Mapping[str, Any], config: dict[str, Any]) -> Iterator[tuple[str, Feature]]:
    """Yield the joined states and the cameras, as ``IsaaclabArenaProcessorStep`` passes them on."""
    states = _boxes(inner.get("policy"))
    sizes = [prod(states[key].shape) for key in config["state_keys"] if key in states]
    if sizes:
        yield "policy", Feature(OBS_STATE, FeatureType.STATE, (sum(sizes),), "policy")
    yield from _cameras(inner.get("camera_obs"), config["camera_keys"], "camera_obs")


def _boxes(space: Any) -> dict[str, Box]:
    spaces = space.spaces if isinstance(space, Dict) else {}
    return {name: box for name, box in spaces.items() if isinstance(box, Box) and box.shape}


def _inner(spaces: Mapping[str, Any], path: tuple[str, str]) -> Any:
    """Return the space at a path in ``robot_state``, or None."""
    group = getattr(spaces.get("robot_state"), "spaces", {}).get(path[0])
    return getattr(group, "spaces", {}).get(path[1])


def _is_vector(space: Any, size: int) -> bool:
    return isinstance(space, Box) and space.shape == (size,)


def _split(text: str) -> list[str]:
    return [key for part in text.split(",") if (key := part.strip())]


def as_features(seen: Mapping[str, Feature]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return ``features`` and ``features_map`` of an ``EnvConfig``."""
    features = {key: PolicyFeature(type=item.kind, shape=item.shape) for key, item in seen.items()}
    return features, {key: item.policy_key for key, item in seen.items()}
