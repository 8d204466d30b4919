"""Tests of the worker's ``lockdown``."""
