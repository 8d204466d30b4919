"""Features that the core finds by name and does without, a folder for each."""
