"""Where everything lies in the memory that a runner shares with the client or the server."""
