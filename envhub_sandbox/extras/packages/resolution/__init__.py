"""From requirements to wheels: the index, uv, what was resolved."""
