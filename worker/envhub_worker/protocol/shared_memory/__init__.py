"""Where everything lies in the memory that client and runner share. Pure arithmetic."""
