"""Be what another jail attacks: hold a secret everywhere, count signals. Not an attack itself."""

import ctypes
import os
import signal
import tempfile

kept = {"signals": 0, "broadcasts": 0}


def attack(secret):
    if secret is None:
        came = {name: kept[name] for name in ("signals", "broadcasts")}
        return {**came, "text": kept["buffer"].raw.decode("ascii", "replace")}
    ctypes.CDLL(None).prctl(0x59616D61, ctypes.c_ulong(-1), 0, 0, 0)  # PR_SET_PTRACER
    signal.signal(signal.SIGURG, _count)
    signal.signal(signal.SIGWINCH, _count)  # what is sent to everybody
    os.environ["SECRET"] = secret
    kept["buffer"] = ctypes.create_string_buffer(secret.encode())
    folder = os.path.expanduser("~")
    kept["file"] = tempfile.NamedTemporaryFile(dir=folder)  # noqa: SIM115
    kept["file"].write(secret.encode())
    kept["file"].flush()
    os.chmod(kept["file"].name, 0o644)
    os.chmod(folder, 0o755)
    return {
        "address": ctypes.addressof(kept["buffer"]),
        "size": len(secret),
        "fd": kept["file"].fileno(),
        "path": kept["file"].name,
    }


def _count(number, _):
    kept["broadcasts" if number == signal.SIGWINCH else "signals"] += 1
