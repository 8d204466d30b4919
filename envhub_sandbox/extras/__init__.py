"""Optional features, a folder each, which the core finds by name and works without."""
