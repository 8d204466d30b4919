"""Tests of the worker's ``supervisor``."""
