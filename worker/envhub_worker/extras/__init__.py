"""Features that the core finds by name and does without."""
