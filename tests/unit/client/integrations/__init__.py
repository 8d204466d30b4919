"""Unit tests of ``envhub_sandbox/integrations``."""
