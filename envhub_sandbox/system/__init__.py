"""What several packages ask of the operating system: locks, whole files, facts of ``/proc``."""
