"""The one word of a slab that is read without mapping it, and without numpy or Gymnasium."""

from __future__ import annotations

SEQUENCE = 0
"""Counts requests, or replies; polled by the other side."""
