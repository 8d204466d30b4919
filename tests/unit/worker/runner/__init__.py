"""Tests of the worker's ``runner``."""
