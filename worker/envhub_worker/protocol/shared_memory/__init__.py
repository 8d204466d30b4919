"""Where everything lies in the memory that client and runner share. Pure arithmetic."""

SEQUENCE = 0
"""The word of a slab that counts requests, or replies; polled by the other side. It stands here for
the server, which has neither numpy nor Gymnasium."""
