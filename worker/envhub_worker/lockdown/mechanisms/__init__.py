"""One file a mechanism of the kernel. Own ctypes code: no system library is needed."""
