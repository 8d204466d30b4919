"""Crash bundles: what was asked is noted, written after a death, read and replayed."""
