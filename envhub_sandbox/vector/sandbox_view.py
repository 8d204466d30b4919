"""``env.sandbox``: answers a user's questions about the sandbox around an environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from envhub_sandbox.session.env_session import EnvSession


class SandboxView:
    """Shows the confinement of an environment, its resource usage, denials and counters.

    The data come from the client and its worker server, never from the repository. Each method may
    be called at any time, from any thread.
    """

    def __init__(self, session: EnvSession) -> None:
        self._session = session

    def report(self) -> list[dict[str, Any]]:
        """One mapping per layer: ``layer``, ``enforced``, ``detail``; empty unless it runs."""
        return [dict(layer) for layer in self._session.report()]

    def usage(self) -> dict[str, int]:
        """What the environment's jail uses now, counted by the worker server from outside.

        Returns:
            ``processes`` and ``threads`` (beyond one for each process); for the processes that run
            environments also ``files`` (open ones) and ``memory_bytes`` (not shared). Empty unless
            it runs.
        """
        return self._session.usage()

    def memory_limit(self) -> int:
        """The bytes that its processes may use: the policy's limit of a jail, times its jails."""
        return self._session.jails * self._session.repository.policy.limits.memory_bytes

    def denials(self) -> tuple[str, ...] | None:
        """The denied attempts of its jail, which the jail's first process has recorded.

        Returns:
            System calls (``"ptrace"``, ``"socket AF_INET"``), files outside its own folders
            (``"write /home/me/.profile"``), other processes (``"kill OTHER_PROCESS"``), and limits
            that it has reached now (``"limit PROCESSES"``, ``OPEN_FILES``, ``DISK_BYTES`` or
            ``DISK_FILES``). None unless it runs under a policy with ``record_denials``.
        """
        return self._session.denials()

    def stats(self) -> dict[str, Any]:
        """Counters; sends no request.

        Returns:
            ``requests``, ``steps``, ``timeouts``, ``deaths``, ``restarts`` (after deaths),
            ``stale_replies``, ``sent_bytes`` and ``received_bytes`` (over both lanes; infos in
            shared memory are not counted), ``state``, and ``step_latency_s``: from the request to
            the reply in seconds, ``p50``, ``p90``, ``p99`` and ``max`` of the last 1024 steps, and
            the ``total`` of all.
        """
        return self._session.stats()

    def __reduce__(self) -> tuple[Any, ...]:
        # Also for copy and deepcopy: the session has sockets and processes, which an incomplete
        # copy of it would close. The environment itself can be copied and has a view of its own.
        raise TypeError(f"{self!r} is of one running environment; copy or pickle that environment")

    def __repr__(self) -> str:
        return f"<sandbox of {self._session.repository.label}>"
