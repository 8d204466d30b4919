"""Tests of the worker's ``spawn``."""
