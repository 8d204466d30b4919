"""The worker: executes a repository's environments under confinement, and serves them.

Self-contained: it needs only the standard library, numpy, gymnasium, msgpack, pyzmq and
cloudpickle, so that any interpreter can load this folder. Imported as ``envhub_worker``.
"""

__version__ = "0.1.0"
