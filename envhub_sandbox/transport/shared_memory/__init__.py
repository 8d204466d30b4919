"""Lanes that step through slabs, which a runner shares with the client or with the server."""
