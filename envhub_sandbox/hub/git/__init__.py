"""Git as a source of files: a commit of another host, and what would be committed of a folder."""
