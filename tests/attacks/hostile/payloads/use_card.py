"""CUDA without a library above the driver: name the card, and read or offer memory on it."""

import ctypes
import sys


class Handle(ctypes.Structure):
    """``CUipcMemHandle``: other processes map memory by it."""

    _fields_ = (("data", ctypes.c_char * 64),)


def use_card(handle="", size=16):
    cuda = start()
    name = ctypes.create_string_buffer(100)
    check(cuda.cuDeviceGetName(name, 100, 0), "cuDeviceGetName")
    found = {"name": name.value.decode(), "read": ""}
    if handle:
        address, taken = ctypes.c_uint64(), ctypes.create_string_buffer(size)
        theirs = Handle.from_buffer_copy(bytes.fromhex(handle))
        error = cuda.cuIpcOpenMemHandle_v2(ctypes.byref(address), theirs, 1)
        if not error:
            check(cuda.cuMemcpyDtoH_v2(taken, address, size), "cuMemcpyDtoH")
            found["read"] = taken.raw.decode(errors="replace")
        found["error"] = error
    return found


def start():
    cuda = ctypes.CDLL("libcuda.so.1")
    context = ctypes.c_void_p()
    check(cuda.cuInit(0), "cuInit")
    check(cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0), "cuDevicePrimaryCtxRetain")
    check(cuda.cuCtxSetCurrent(context), "cuCtxSetCurrent")
    return cuda


def check(error, what):
    if error:
        raise OSError(f"{what}: error {error}")


def offer(text):
    """Write a text into memory on the card, print its handle, and keep it until stdin ends."""
    cuda = start()
    address, handle = ctypes.c_uint64(), Handle()
    check(cuda.cuMemAlloc_v2(ctypes.byref(address), ctypes.c_size_t(1 << 21)), "cuMemAlloc")
    check(cuda.cuMemcpyHtoD_v2(address, text.encode(), len(text)), "cuMemcpyHtoD")
    check(cuda.cuIpcGetMemHandle(ctypes.byref(handle), address), "cuIpcGetMemHandle")
    print(bytes(handle).hex(), flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    offer(sys.argv[1])
