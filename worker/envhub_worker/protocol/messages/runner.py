"""Between client and runner, about environments. The server relays these and never decodes them."""

from __future__ import annotations

from envhub_worker.protocol.messages.message import Message

CONFIG_CLASS = "<class>"
"""The key, among an object's attributes in ``Load.cfg``, of what its class is: ``(names, fields,
computed)``.

``names`` are pairs of a module's and a class's name, in the order of inheritance; none for a
mapping of another class than dict. ``fields`` are the names of its fields; None where ``value``
stands for the whole, as of an enum's member. ``computed`` has the values of its properties.
"""


class Load(Message, kind=64, asks="make_env", handed=("cfg", "env_kwargs")):
    """Import the entry file and call its ``make_env``. Reply: ``LoadDone`` or ``RaisedException``.

    ``cfg`` holds the ``vars()`` of the caller's config object, or None; see ``CONFIG_CLASS``. For
    ``play_ms`` milliseconds from now on sub-environments may be played to see whether they are
    independent.
    """

    n_envs: int
    use_async_envs: bool
    cfg: dict[str, object] | None
    env_kwargs: dict[str, object]
    play_ms: int = 0


class LoadDone(Message, kind=65):
    """What the repository's ``make_env`` returned: see ``manifest.decode_manifest``."""

    manifest: dict[str, object]


class Build(Message, kind=66):
    """Build sub-environments ``start`` to ``stop`` of a task as ``env``. Reply: ``BuildDone``."""

    env: int
    suite: str
    task: object
    start: int
    stop: int


class BuildDone(Message, kind=67):
    """The slice is ready: see ``manifest.decode_env``."""

    manifest: dict[str, object]


class Reset(Message, kind=68, asks="reset", handed=("options",)):
    """``seeds`` is None or one seed or None per sub-environment of the slice; so is ``mask``."""

    env: int
    seeds: object
    options: object
    mask: object


class ResetDone(Message, kind=69):
    """Batched observation and infos of the slice."""

    observation: object
    info: dict[object, object]


class Step(Message, kind=70, asks="step"):
    """The slice's batch of actions."""

    env: int
    actions: object


class StepDone(Message, kind=71):
    """Batched results of the slice."""

    observation: object
    rewards: object
    terminations: object
    truncations: object
    info: dict[object, object]


class Call(Message, kind=72, asks="call", handed=("args", "kwargs")):
    """``VectorEnv.call``: a method or attribute of every sub-environment. Reply: ``Value``."""

    env: int
    name: str
    args: tuple[object, ...]
    kwargs: dict[str, object]


class SetAttr(Message, kind=73, asks="set_attr", handed=("values",)):
    """One value per sub-environment of the slice. Reply: ``Value``."""

    env: int
    name: str
    values: tuple[object, ...]


class Render(Message, kind=74):
    """``VectorEnv.render``. Reply: ``Value`` with a tuple of frames or None."""

    env: int


class GetOwn(Message, kind=75):
    """An attribute of the vector environment itself. Reply: ``Value``, or ``Method``."""

    env: int
    name: str


class Method(Message, kind=76):
    """The attribute is callable; ``CallOwn`` calls it."""


class CallOwn(Message, kind=77, asks="method", handed=("args", "kwargs")):
    """Call a method of the vector environment itself. Reply: ``Value``."""

    env: int
    name: str
    args: tuple[object, ...]
    kwargs: dict[str, object]


class GetOne(Message, kind=78):
    """An attribute of one sub-environment. Reply: ``Value``, or ``Method`` if it can be called."""

    env: int
    index: int | None
    depth: int | None
    name: str


class CallOne(Message, kind=79, asks="envs", handed=("args", "kwargs")):
    """Call a method of one sub-environment, which ``GetOne`` describes. Reply: ``Value``."""

    env: int
    index: int | None
    depth: int | None
    name: str
    args: tuple[object, ...]
    kwargs: dict[str, object]


class GetRandom(Message, kind=80):
    """Ask for the generators. Reply: ``Value``, one state each, or the one state there is.

    A state has a ``number`` beside numpy's fields: another generator has another one.
    """

    env: int


class SetRandom(Message, kind=94):
    """Bring generators to these states; None leaves one as it is. Reply: ``Value``.

    ``new``: by generators of their own, which take the places of those that are there.
    """

    env: int
    states: tuple[object, ...]
    new: bool


class Close(Message, kind=81):
    """Close an environment. Reply: ``Value`` with None."""

    env: int


class Attach(Message, kind=82):
    """Serve an environment's steps over the slabs and doorbells that come along. Reply: ``Value``.

    The shard's rows of a batch of ``count`` begin at ``start``. If ``count`` is 0, steps are
    messages, and a slot is for the answer to one. False: it has no fixed layout.
    """

    env: int
    start: int
    count: int
    slots: int


class FetchInfos(Message, kind=83):
    """Ask for the last step's infos, which did not fit the slab. Reply: ``Value``."""

    env: int


class Revive(Message, kind=84):
    """Reset all sub-environments in the place of others, which died in the middle of an episode.

    Reply: ``StepDone``: the fresh observations, rewards of zero, every episode truncated. What
    the next step does with those is as the autoreset mode says.
    """

    env: int
    seeds: object


class FetchInfosApart(Message, kind=85):
    """Ask for the last infos as each sub-environment gave them. Reply: ``Value`` of triples.

    ``failed``: those cannot be joined, and the step that they are of has failed. None are sent.
    """

    env: int
    failed: bool = False


class TakeApart(Message, kind=93):
    """Infos are not joined from now on, but each sub-environment's own. Reply: ``Value``."""

    env: int


class LoadTask(Message, kind=86, asks="make_env", handed=("cfg", "env_kwargs")):
    """As ``Load``, where the manifest is known. Reply: ``Value`` or ``RaisedException``."""

    n_envs: int
    use_async_envs: bool
    cfg: dict[str, object] | None
    env_kwargs: dict[str, object]
    suite: str
    task: object


class Value(Message, kind=87):
    """A result."""

    value: object


class Warnings(Message, kind=88):
    """In front of the frames of a reply: what the repository has warned of."""

    warnings: tuple[object, ...]


class Watch(Message, kind=89, asks="call"):
    """As ``Call`` without arguments; its result is watched from now on. Reply: ``WatchDone``."""

    env: int
    name: str


class WatchDone(Message, kind=90):
    """What ``Call`` would have answered, and whether it stays so until a ``Changes`` says other."""

    value: object
    watched: bool


class Changes(Message, kind=91):
    """In front of the frames of a reply: what is another now, and watched no more."""

    attributes: tuple[object, ...]


class RaisedException(Message, kind=92):
    """The repository's code raised. ``builtin`` is its nearest builtin ancestor."""

    builtin: str
    type_name: str
    message: str
    traceback: str
    stage: str
    """``"import"``, ``"make_env"``, ``"return"`` or the operation."""
