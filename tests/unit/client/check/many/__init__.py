"""Unit tests of ``envhub_sandbox/check/many``."""
