"""One environment over several workers: where they go, and what becomes of it when they go."""
