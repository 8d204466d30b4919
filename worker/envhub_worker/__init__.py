"""The worker: executes a repository's environments under confinement, and serves them.

Self-contained: the standard library, numpy, gymnasium, msgpack, pyzmq and cloudpickle only, so
that this one folder can be put in front of any interpreter. Imported as ``envhub_worker``.
"""

__version__ = "0.1.0"
