"""Values and objects that callers hand over, and what programs look for in them."""
