"""The wire between client, worker server and jail. No I/O here, and nothing is unpickled."""
