"""Records about layers of the lockdown: enforced ones, and those that this host lacks."""

from __future__ import annotations

from envhub_worker.protocol.records import dataclass


@dataclass(frozen=True)
class Layer:
    """One layer that was enforced or deliberately was not."""

    layer: str
    enforced: bool
    detail: str


class LayerUnavailableError(Exception):
    """This host lacks a layer that the profile requires, so nothing may run.
    ``fix``: what the user can do, with the exact command if there is one.
    """

    def __init__(self, layer: str, reason: str, fix: str) -> None:
        super().__init__(f"{layer}: {reason}. {fix}")
        self.layer = layer
        self.reason = reason
        self.fix = fix

    def to_wire(self) -> dict[str, str]:
        """Plain data: ``{"layer", "reason", "fix"}``."""
        return {"layer": self.layer, "reason": self.reason, "fix": self.fix}


def no_system_calls(machine: str) -> LayerUnavailableError:
    """Returns the error that there is no table of system calls for ``machine``."""
    return LayerUnavailableError(
        "seccomp",
        f"no system call table for {machine}",
        "Run on x86-64 or aarch64, or in a container on such a host.",
    )
