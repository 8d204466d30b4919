"""Unit tests of the client, one module at a time."""
