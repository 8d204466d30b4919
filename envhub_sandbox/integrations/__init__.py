"""Sandboxed environments with other libraries' interfaces, one module for each library."""
