"""One file per mechanism that confines a jail. Own ctypes code: no system library is needed."""
