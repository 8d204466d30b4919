"""Unit tests of what plays in ``envhub_sandbox/check/play``."""
