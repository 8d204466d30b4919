"""Ray as a place for workers, without Ray."""
