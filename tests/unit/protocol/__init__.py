"""Unit tests of the wire."""
