"""System calls by name, without a library that might know better. Not an attack itself."""

import ctypes
import os
import platform
import time

from .running import call_me

_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.syscall.restype = ctypes.c_long

# name, x86-64, aarch64
_NUMBERS = """
acct 163 89; add_key 248 217; bpf 321 280; capset 126 91; clone 56 220; clone3 435 435;
delete_module 176 106; epoll_pwait2 441 441; execveat 322 281; fanotify_init 300 262;
finit_module 313 273; fsmount 432 432; fsopen 430 430; fspick 433 433; futex_waitv 449 449;
get_robust_list 274 100; init_module 175 105; io_uring_enter 426 426; io_uring_register 427 427;
io_uring_setup 425 425; ioperm 173 -; iopl 172 -; ioprio_set 251 30; kcmp 312 272;
kexec_file_load 320 294; kexec_load 246 104; keyctl 250 219; memfd_secret 447 447;
migrate_pages 256 238; mknodat 259 33; mlockall 151 230; modify_ldt 154 -; mount 165 40;
mount_setattr 442 442; move_mount 429 429; move_pages 279 239; mseal 462 462;
name_to_handle_at 303 264; open_by_handle_at 304 265; open_tree 428 428; openat2 437 437;
perf_event_open 298 241; pidfd_getfd 438 438; pidfd_open 434 434; pidfd_send_signal 424 424;
pivot_root 155 41; pkey_alloc 330 289; pkey_free 331 290; prctl 157 167; prlimit64 302 261;
process_madvise 440 440; process_mrelease 448 448; process_vm_readv 310 270;
process_vm_writev 311 271; ptrace 101 117; quotactl 179 60; readahead 187 213; reboot 169 142;
request_key 249 218; rt_sigqueueinfo 129 138; seccomp 317 277; setdomainname 171 162;
sethostname 170 161; setns 308 268; settimeofday 164 170; shmat 30 196; shmctl 31 195;
shmget 29 194; signalfd4 289 74; splice 275 76; swapoff 168 225; swapon 167 224;
sync_file_range 277 84; syslog 103 116; tee 276 77; umount2 166 39; unshare 272 97;
userfaultfd 323 282; utime 132 -; vhangup 153 58
"""
NUMBERS = {
    name: tuple(None if one == "-" else int(one) for one in both)
    for name, *both in map(str.split, _NUMBERS.split(";"))
}
CLONE_NEWNS, CLONE_NEWUSER, CLONE_NEWNET = 0x20000, 0x10000000, 0x40000000


def number(name):
    """The call's number on this machine, or None."""
    return NUMBERS[name][platform.machine() == "aarch64"]


def syscall(name, *arguments):
    """Make a system call. Integers, bytes, buffers and ctypes objects pass as they are."""
    words = [
        ctypes.c_long(word) if isinstance(word, int) or word is None else word
        for word in (0 if word is None else word for word in arguments)
    ]
    result = _LIBC.syscall(ctypes.c_long(number(name)), *words)
    if result < 0:
        error = ctypes.get_errno()
        raise OSError(error, f"{name}: {os.strerror(error)}")
    return result


def in_child(alias, work):
    """Fork; the child is called ``alias``, does ``work`` and stays. Returns what it printed."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            try:
                answer = repr(work())
            except BaseException as error:
                answer = f"{type(error).__name__}: {error}"
            call_me(alias)
            os.write(write, answer.encode())
            os.close(write)
            time.sleep(120)
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        return pipe.read().decode()


def become_root_of_a_namespace(flags):
    """Unshare ``flags``, in a user namespace of our own where that takes one."""
    uid, gid = os.getuid(), os.getgid()
    try:
        syscall("unshare", flags)
    except PermissionError:
        syscall("unshare", flags | CLONE_NEWUSER)
        for name, text in (
            ("setgroups", "deny"),
            ("uid_map", f"0 {uid} 1"),
            ("gid_map", f"0 {gid} 1"),
        ):
            with open(f"/proc/self/{name}", "w") as file:
                file.write(text)
