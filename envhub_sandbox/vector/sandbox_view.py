"""``env.sandbox``: what a user may ask about the sandbox around an environment."""

from __future__ import annotations

from typing import Any

from envhub_sandbox.session.env_session import EnvSession


class SandboxView:
    """What confines an environment, what that holds, was denied and has done.

    The answers are the client's and its worker server's, never the repository's. Each method may
    be called at any moment, from any thread, and answers for that moment.
    """

    def __init__(self, session: EnvSession) -> None:
        self._session = session

    def report(self) -> list[dict[str, Any]]:
        """One mapping per layer: ``layer``, ``enforced``, ``detail``. None unless it runs."""
        return [dict(layer) for layer in self._session.lease.report()]

    def usage(self) -> dict[str, int]:
        """What its jail holds right now, counted from outside of it by the worker server.

        Returns:
            ``processes`` and ``threads`` (beyond one for each process); of the processes that run
            environments ``files``, which they have open, and ``memory_bytes``, what is theirs
            alone. Empty unless it runs.
        """
        return self._session.usage()

    def denials(self) -> tuple[str, ...] | None:
        """Which system calls its jail has tried and was denied: ``("ptrace", "socket AF_INET")``.

        And which files it has asked for that are not its own: ``"write /home/me/.profile"``, and
        what it has tried with processes that are not: ``"kill OTHER_PROCESS"``. By the word of its
        first process, which answers or sees them, and not by the repository's. Also which limits it
        has used up when the server looks: ``"limit PROCESSES"``, ``OPEN_FILES``, ``DISK_BYTES`` or
        ``DISK_FILES``. None unless it runs under a policy with ``record_denials``.
        """
        return self._session.lease.denials()

    def stats(self) -> dict[str, Any]:
        """Counters; asks nothing of the worker.

        Returns:
            ``requests``, ``steps``, ``timeouts``, ``deaths``, ``restarts`` (after deaths),
            ``stale_replies``, ``sent_bytes`` and ``received_bytes`` (over both lanes; infos in
            shared memory are not counted), ``state``, and ``step_latency_s``: from the request to
            the reply in seconds, ``p50``, ``p90``, ``p99`` and ``max`` of the last 1024 steps, and
            the ``total`` of all.
        """
        return self._session.stats()

    def __reduce__(self) -> tuple[Any, ...]:
        # Also for copy and deepcopy: what it looks at has sockets and processes, which a half-made
        # copy would close. The environment itself can be copied and has a view of its own.
        raise TypeError(f"{self!r} is of one running environment; copy or pickle that environment")

    def __repr__(self) -> str:
        return f"<sandbox of {self._session.repository.label}>"
