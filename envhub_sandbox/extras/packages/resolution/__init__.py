"""Resolves requirements to wheels: settings for the index, uv, and remembered resolutions."""
