"""What the client makes of a worker that lies: nothing runs here, and memory stays bounded."""
