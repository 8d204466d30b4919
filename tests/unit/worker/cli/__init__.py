"""Tests of the worker's ``cli``."""
