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


NEW_ROLLOUT = "lerobot_new_rollout"
"""The option of a reset by which LeRobot announces a rollout."""


SPACES = "<spaces>"
"""In place of an attribute in ``Changes``: a reset has seeded or replaced the spaces of the first
sub-environment.
"""


class Load(Message, kind=64, asks="make_env", handed=("cfg", "env_kwargs")):
    """Import the entry file and call its ``make_env``. Reply: ``LoadDone`` or ``RaisedException``.

    ``cfg`` holds the ``vars()`` of the caller's config object, or None; see ``CONFIG_CLASS``. The
    runner may play sub-environments for ``play_ms`` milliseconds to see whether they are
    independent.
    """

    n_envs: int
    use_async_envs: bool
    cfg: dict[str, object] | None
    env_kwargs: dict[str, object]
    play_ms: int = 0


class LoadDone(Message, kind=65):
    """The manifest of the environments that ``make_env`` returned: see ``decode_manifest``."""

    manifest: dict[str, object]


class Build(Message, kind=66):
    """Build sub-environments ``start`` to ``stop`` of a task as ``env``. Reply: ``BuildDone``."""

    env: int
    suite: str
    task: object
    start: int
    stop: int


class BuildDone(Message, kind=67):
    """The slice is ready; with its manifest: see ``decode_env``."""

    manifest: dict[str, object]


class Reset(Message, kind=68, asks="reset", handed=("options",)):
    """Reset the slice. ``seeds`` and ``mask`` are None or have one entry per sub-environment."""

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


class Method(Message, kind=76):
    """The attribute is callable; ``CallOne`` calls it."""


ITSELF = -1
"""In place of a sub-environment's index: the vector environment itself."""


class GetOne(Message, kind=78):
    """An attribute of one sub-environment, or of the vector environment itself. Reply: ``Value``,
    or ``Method`` if it can be called.
    """

    env: int
    index: int | None
    depth: int | None
    name: str


class CallOne(Message, kind=79, asks="method", handed=("args", "kwargs")):
    """Call a method that ``GetOne`` describes. Reply: ``Value``."""

    env: int
    index: int | None
    depth: int | None
    name: str
    args: tuple[object, ...]
    kwargs: dict[str, object]


class GetRandom(Message, kind=80):
    """Ask for the generators' states. Reply: ``Value`` with one state per sub-environment, or the
    state of the vector environment's only generator.

    A state has a ``number`` beside numpy's fields, which identifies the generator.
    """

    env: int


class SetRandom(Message, kind=94):
    """Set generators to these states; None leaves a generator unchanged. Reply: ``Value``.

    ``new``: make new generators in these states, which replace the present ones.
    """

    env: int
    states: tuple[object, ...]
    new: bool


class Close(Message, kind=81):
    """Close an environment. Reply: ``Value`` with None."""

    env: int


class Attach(Message, kind=82):
    """Serve steps over the slabs and doorbells that this message brings. Reply: ``Value``.

    The shard's rows of a batch of ``count`` begin at ``start``. If ``count`` is 0, steps are
    messages, and a slot holds the answer to one step. The value False means that the environment
    has no fixed layout.
    """

    env: int
    start: int
    count: int
    slots: int


class FetchInfos(Message, kind=83):
    """Ask for the last step's infos, which did not fit into the slab. Reply: ``Value``."""

    env: int


class Revive(Message, kind=84):
    """Reset all sub-environments, which replace others that died in the middle of an episode.

    Reply: ``StepDone`` with the new observations, zero rewards, and every episode truncated. The
    autoreset mode decides what the next step does with the truncated episodes; in a ``rollout``
    that was announced, they stay ended until the next one.
    """

    env: int
    seeds: object
    rollout: bool = False


class ForgetEnds(Message, kind=85):
    """The infos of the last step cannot be joined: note no ended episode. Reply: ``Value``."""

    env: int


class TakeApart(Message, kind=93):
    """From now on send each sub-environment's own infos, not joined ones. Reply: ``Value``.

    ``single``: the client shows the only sub-environment as a ``gymnasium.Env``, which nobody but
    the caller resets.
    """

    env: int
    single: bool = False


class LoadTask(Message, kind=86, asks="make_env", handed=("cfg", "env_kwargs")):
    """Like ``Load``, but the client has the manifest. Reply: ``Value`` or ``RaisedException``."""

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
    """In front of the frames of a reply: the warnings that the repository has issued."""

    warnings: tuple[object, ...]


class Watch(Message, kind=89, asks="call"):
    """Like ``Call`` without arguments; the runner then watches its result. Reply: ``WatchDone``."""

    env: int
    name: str


class WatchDone(Message, kind=90):
    """The result of ``Call``, and whether it stays valid until ``Changes`` names the attribute."""

    value: object
    watched: bool


class Changes(Message, kind=91):
    """In front of the frames of a reply: attributes that have changed, so are watched no more."""

    attributes: tuple[object, ...]


class RaisedException(Message, kind=92):
    """The repository's code raised. ``builtin`` is its nearest builtin ancestor."""

    builtin: str
    type_name: str
    message: str
    traceback: str
    stage: str
    """``"import"``, ``"make_env"``, ``"return"`` or the operation."""
