"""What has an end: processes, memory, disk, time, and what the kernel counts per user."""
