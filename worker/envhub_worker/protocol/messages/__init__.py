"""Every message, one class each; ``docs/protocol.md`` has what each field means.

Two conversations share this package: ``server.py`` is between client and worker server, to open
and close jails and to relay; ``runner.py`` is between client and runner, about environments.
"""

# ruff: noqa: F403 - the names are sixty, and stand in these modules
from envhub_worker.protocol.messages.message import *
from envhub_worker.protocol.messages.runner import *
from envhub_worker.protocol.messages.server import *
