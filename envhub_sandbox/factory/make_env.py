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
    sandbox: str | Sandbox | Sequence[str | Sandbox] | None = "process",
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
    min_ready: int | None = None,
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
            ``.py`` file (``"env.py"``), or a ``HubEnvConfig``-like object with
            ``hub_path``, whose ``vars()`` and public properties the repository's ``make_env``
            gets as ``cfg``.
        n_envs: Number of sub-environments, passed to the repository's ``make_env``.
        use_async_envs: Also passed to it; if True, sub-environments may run in several processes.
        hub_cache_dir: huggingface_hub's ``cache_dir``.
        trust_remote_code: Only for ``sandbox=None``.
        sandbox: Where the code runs: ``"process"``; ``"docker"``, ``"docker:IMAGE"`` or a
            ``DockerSandbox``; ``"ray"`` or a ``RaySandbox``; ``"tcp://HOST:PORT"`` or a
            ``RemoteSandbox``. A list of these, ``"file:PATH"``, ``"dns://HOST:PORT"`` or a
            ``Fleet`` spreads the sub-environments of each environment over several places
            (``docs/scaling.md``). None runs the code in this process without protection, as
            LeRobot does.
        env_kwargs: Further keyword arguments for the repository's ``make_env``.
        policy: What the code may reach; see ``Policy``.
        timeouts: How long operations may take; see ``Timeouts``.
        limits: Hard caps; a mapping overrides those of ``policy.limits`` that it names.
        token: As in huggingface_hub.
        endpoint: As in huggingface_hub.
        python: The interpreter that runs the repository; this one by default. It needs cloudpickle,
            gymnasium, msgpack and numpy beside the repository's own packages.
        dependencies: Where its packages come from. ``"auto"`` installs what it declares and imports
            into a separate environment, if this interpreter lacks some of it; ``"declared"``
            installs only what it declares; ``"host"`` uses this interpreter's packages; a path
            uses those of that interpreter or virtual environment. A mapping always makes a
            separate environment:
            ``{"extra": ["scipy"], "python": "3.12", "exclude_newer": "2026-01-31"}``, also with
            ``only``, ``without``, ``override`` and ``fetch_python``. See ``docs/dependencies.md``.
        lock: A file of ``envhub lock``: its packages are used, and any difference from it (commit,
            files, Python, spaces) is an error. For ``sandbox="process"``.
        assets: Other repositories of the Hub that the code may read, at most sixteen, as in
            ``["datasets/org/data@<commit>"]``; without a prefix a model, a dataset or a Space. They
            are verified like its own files, and ``snapshot_download`` and ``hf_hub_download`` find
            them without a network. See ``docs/authors.md``.
        num_workers: Number of processes for the sub-environments. The default is one; with
            ``use_async_envs`` it is the number that was fastest in the first uses, and with several
            places in ``sandbox`` it is one for each place.
        prewarm: How many of a suite's next tasks start in the background when a task is first
            reset; this is also the maximum of unused jails. By default one, if tasks are closed
            before the next is reset, on this machine and without a GPU; otherwise none.
        min_ready: How many sub-environments ``env.recv`` waits for by default. Each sub-environment
            then has its own worker, or ``num_workers`` workers share them: the sub-environments of
            one worker are stepped together, and so are ready together. ``reset`` and ``step`` work
            as before.
        lane: ``"auto"`` steps over shared memory where that is possible, ``"frames"`` never does.
        copy: False returns observations in shared memory instead of copies. As in Gymnasium, no
            later step changes an array that is still in use; but the worker can.
        validate: Compare every action and observation with its space, value by value: for tests,
            because it is slower. Shapes and dtypes are always checked.
        server_key: For ``sandbox="tcp://..."``: that server's public key.

    Returns:
        ``{suite: {task_id: VectorEnv}}``. Environments of a known pin start no process before
        they are used.

    Raises:
        HubReferenceError: ``cfg`` cannot be read.
        TypeError, ValueError: A plain argument is invalid.
        SnapshotError: The files cannot be downloaded, or differ from the commit.
        PolicyError: An unknown or impossible policy, limit or timeout.
        SandboxUnavailableError: This host cannot enforce the policy.
        LockError: The lock cannot be read; or something differs from it (``LockDriftError``).
        DependencyError: Its packages cannot be installed, or it imports an undeclared one.
        LoadError: The repository failed to load, or returned no environment.
        WorkerError: The worker did not come up, died, or took too long; or a server has no room
            (``ServerBusyError``).
        RuntimeError: ``sandbox=None`` without ``trust_remote_code=True``.
    """
    given = locals().copy()  # the arguments, as long as nothing else has a name here
    return make(make_env, given.pop("cfg"), Options(**given))
