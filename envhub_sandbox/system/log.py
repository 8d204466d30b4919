"""Our part of the ``logging`` tree. Silent until the application that uses us sets it up.

``envhub_sandbox.worker`` logs jails: opened, closed (DEBUG), died, timed out, restarted (INFO).
``envhub_sandbox.worker.output`` has every line that they print (DEBUG). ``envhub_sandbox.snapshot``
logs downloads, ``envhub_sandbox.dependencies`` packages, ``envhub_sandbox.crashes``
crash bundles. ``envhub_sandbox.errors`` has our own frames of what is raised (DEBUG).
"""

from __future__ import annotations

import logging

ROOT = logging.getLogger("envhub_sandbox")
ROOT.addHandler(logging.NullHandler())
WORKER = ROOT.getChild("worker")
OUTPUT = WORKER.getChild("output")
SNAPSHOT = ROOT.getChild("snapshot")
DEPENDENCIES = ROOT.getChild("dependencies")
CRASHES = ROOT.getChild("crashes")
ERRORS = ROOT.getChild("errors")
