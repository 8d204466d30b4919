"""Lanes that step through slabs: memory that a runner shares with the client or the server."""
