"""Benchmarks of envhub-sandbox against Gymnasium's vector environments and others.

``python -m benchmarks --help``, from a clone of the repository.
"""
