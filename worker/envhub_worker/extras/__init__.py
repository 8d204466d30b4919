"""Optional features, which the core finds by name and works without."""
