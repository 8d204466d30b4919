"""Other processes: the client's, the server's, another jail's, another client's."""
