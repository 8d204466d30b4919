"""Tests of what builds wheels out of sources."""
