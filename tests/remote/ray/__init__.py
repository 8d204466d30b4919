"""Worker servers on a Ray cluster of several nodes, all of them on this machine.
Skipped without Ray, which is too large for the step ``tests``: the step ``ray`` of CI has them."""
