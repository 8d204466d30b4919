"""One module for each kernel mechanism. They call the kernel by ctypes and need no libraries."""
