"""Unit tests of ``envhub_sandbox/crash``."""
