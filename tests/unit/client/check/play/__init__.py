"""Unit tests of ``envhub_sandbox/extras/judge/play``."""
