"""Random environments and calls, here with Gymnasium's classes and in the sandbox: the same."""

from tests.compliance.differential import cases, rows, sharing

KINDS = {"calls": cases, "rows": rows, "sharing": sharing}
"""Each has ``case(number)`` and ``difference(case, calls, further)``."""
