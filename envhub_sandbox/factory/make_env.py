"""``make_env``: reference -> snapshot -> sandbox -> proxies."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envhub_sandbox.factory.make import make
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.settings.options import Options
from envhub_sandbox.settings.policy import Limits, Policy, Timeouts
from envhub_sandbox.vector.suites import EnvSuites
from envhub_sandbox.vector.tracebacks import short_traceback


@short_traceback
def make_env(
    cfg: Any,
    n_envs: int = 1,
    use_async_envs: bool = False,
    hub_cache_dir: str | Path | None = None,
    trust_remote_code: bool = False,
    *,
    sandbox: str | Sandbox | None = "process",
    env_kwargs: Mapping[str, Any] | None = None,
    policy: Policy | Mapping[str, Any] | None = None,
    timeouts: Timeouts | Mapping[str, Any] | None = None,
    limits: Limits | Mapping[str, Any] | None = None,
    token: str | bool | None = None,
    endpoint: str | None = None,
    python: str | Path | None = None,
    dependencies: str | os.PathLike[str] | Mapping[str, Any] = "auto",
    lock: str | os.PathLike[str] | None = None,
    assets: Sequence[str] = (),
    num_workers: int | None = None,
    prewarm: int | None = None,
    lane: str = "auto",
    copy: bool = True,
    validate: bool = False,
    server_key: str | None = None,
) -> EnvSuites:
    """Make the vector environments of a repository, without its code entering this process.

    Args:
        cfg: A hub reference (``"org/repo@commit:path"``), one of git
            (``"github:org/repo@commit:path"``), an id that a package registers
            (``"pypi:minigrid@3.0.0#MiniGrid-Empty-5x5-v0"``), a local folder (``"./my-env"``), a
            ``.py`` file that is here (``"env.py"``), or a ``HubEnvConfig``-like object with
            ``hub_path``, whose ``vars()`` and public properties the repository's ``make_env``
            gets as ``cfg``.
        n_envs: Number of sub-environments, passed to the repository's ``make_env``.
        use_async_envs: Passed on likewise; sub-environments may then run in several processes.
        hub_cache_dir: huggingface_hub's ``cache_dir``.
        trust_remote_code: Only for ``sandbox=None``.
        sandbox: ``"process"``; ``"docker"``, ``"docker:IMAGE"`` or a ``DockerSandbox``;
            ``"tcp://HOST:PORT"`` or a ``RemoteSandbox``; or None to run the code here, as LeRobot
            does, where nothing of what protects can be asked for.
        env_kwargs: Further keyword arguments for the repository's ``make_env``.
        policy: What the code may reach; see ``Policy``.
        timeouts: How long operations may take; see ``Timeouts``.
        limits: Hard caps; a mapping changes those of ``policy.limits`` that it names.
        token: As in huggingface_hub.
        endpoint: As in huggingface_hub.
        python: The interpreter that runs the repository; this one by default. It needs cloudpickle,
            gymnasium, msgpack and numpy beside the repository's own packages.
        dependencies: Where its packages come from. ``"auto"`` makes an environment of its own from
            what it declares and what it imports besides, wheels only, where this interpreter lacks
            some of that; ``"declared"`` takes only what it declares; ``"host"`` takes this
            interpreter as it is; a path that interpreter or virtual environment. A mapping always
            makes one: ``{"extra": ["scipy"], "python": "3.12", "exclude_newer": "2026-01-31"}``,
            also with ``only``, ``without``, ``override`` and ``fetch_python``. See
            ``docs/dependencies.md``; for ``sandbox="process"``.
        lock: A file that ``envhub lock`` wrote: its packages are used and no others, and whatever
            differs from it (commit, files, Python, spaces) is refused. For ``sandbox="process"``.
        assets: Further repositories of the Hub that the code may read, sixteen at most, as in
            ``["datasets/org/data@<commit>"]``; without a prefix a model, a dataset or a space. They
            are verified as its own files are, and ``snapshot_download`` and ``hf_hub_download``
            find them, in a jail without a network. See ``docs/authors.md``.
        num_workers: Processes over which the sub-environments are spread; by default one, or with
            ``use_async_envs`` as many as were fastest when the first uses tried them.
        prewarm: How many of a suite's next tasks are started in the background when a task is first
            reset, and so how many unused jails there are at most. By default one,
            once tasks are seen to be closed before the next is reset, on this machine and without
            a GPU; else none.
        lane: ``"auto"`` steps over shared memory where that is possible, ``"frames"`` never does.
        copy: False lends observations instead of copying them, as in Gymnasium; still no later
            step changes an array that somebody holds, but the worker could.
        validate: Hold every action and observation against its space, value by value: for tests,
            at the cost of speed. Shapes and dtypes are checked in any case.
        server_key: For ``sandbox="tcp://..."``: that server's public key.

    Returns:
        ``{suite: {task_id: VectorEnv}}``. Environments of a known pin start no process before
        they are used.

    Raises:
        HubReferenceError: ``cfg`` cannot be read.
        TypeError, ValueError: A plain argument that nothing can be made of.
        SnapshotError: The files cannot be had, or are not what the commit says.
        PolicyError: An unknown or impossible policy, limit or timeout.
        SandboxUnavailableError: This host cannot enforce the policy.
        LockError: The lock cannot be read; or something is not as it says (``LockDriftError``).
        DependencyError: Its packages cannot be had, or it imports one that it does not declare.
        LoadError: The repository failed to load, or returned something unusable.
        WorkerError: The worker did not come up, died, or took too long; or a server has no room
            (``ServerBusyError``).
        RuntimeError: ``sandbox=None`` without ``trust_remote_code=True``.
    """
    given = locals().copy()  # the arguments, as long as nothing else has a name here
    return make(make_env, given.pop("cfg"), Options(**given))
