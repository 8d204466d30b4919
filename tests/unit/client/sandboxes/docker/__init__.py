"""Unit tests of ``envhub_sandbox/sandboxes/docker``."""
