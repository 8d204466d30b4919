"""From a hub reference to a verified, read-only snapshot on this machine's disk."""
