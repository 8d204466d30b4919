"""Files outside of the jail: read, listed, written, altered."""
