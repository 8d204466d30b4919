"""Lies about all that a worker says, made from what real ones have said.
``python -m tests.fuzz`` runs for as long as it is told; ``tests/attacks/protocol/test_fuzz.py``
runs a bounded number of examples. Whatever is tried ends in a right value or in an error of this
project."""
