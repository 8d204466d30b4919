"""Tests of the worker's ``access``."""
