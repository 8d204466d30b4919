"""Unit tests of ``envhub_worker/lockdown/mechanisms``."""
