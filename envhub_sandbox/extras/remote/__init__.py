"""Worker servers on other hosts: their keys, connections and repositories."""
