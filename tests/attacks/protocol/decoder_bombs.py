"""Messages made to exhaust whoever decodes them, and a victim that decodes all of them.
Run as ``python -m tests.attacks.protocol.decoder_bombs [plain]``. Prints a line of JSON for each:
its name, what came of it, and by how much its memory grew at most. With ``plain`` the
victim is msgpack itself instead of our decoder, and gets the first one. Address space and the CPU
time for each are limited by the kernel."""

import json
import os
import resource
import struct
import sys
from collections.abc import Callable

import msgpack

from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from tests.support.decode import decode
from tests.support.wire import ext, message, packed

MIB = 1024 * 1024
FULL = 8 * MIB - 64
ITEMS = 199_000
ADDRESS_SPACE = 512 * MIB
CPU_S = 60
Frames = list[Buffer]


def array32(count: int, content: bytes) -> bytes:
    return b"\xdd" + struct.pack(">I", count) + content


def map32(count: int, content: bytes) -> bytes:
    return b"\xdf" + struct.pack(">I", count) + content


def extension(code: int, payload: bytes) -> bytes:
    return msgpack.packb(ext(code, payload))


def many(token: bytes, count: int) -> Frames:
    return message(array32(count, token * count))


def nested_claims(opener: bytes, total: int) -> Frames:
    """Containers in containers, each claiming as many elements as it may."""
    levels = total // (len(opener) + 4)
    return message(b"".join(opener + struct.pack(">I", total - 10) for _ in range(levels)))


def colliding_integers() -> Frames:
    """Different integers with one and the same hash: they are hashed modulo a prime."""
    numbers = ((number * (2**61 - 1)).to_bytes(16, "little") for number in range(1, 9001))
    return message(map32(9000, b"".join(extension(3, raw) + b"\xc0" for raw in numbers)))


def colliding_tuples() -> Frames:
    """Different tuples with one and the same hash: -1 and -2 hash alike."""
    keys = [tuple(-1 - (number >> bit & 1) for bit in range(12)) for number in range(4096)]
    return packed([ext(17), *([ext(16), *key] for key in keys)])


def colliding_in_small_maps() -> Frames:
    """Many maps, each too small to be looked at, with colliding keys."""
    keys = [tuple(-1 - (number >> bit & 1) for bit in range(6)) for number in range(64)]
    one: bytes = msgpack.packb([ext(17), *([ext(16), *key] for key in keys)])
    return many(one, 380)


REFUSED: dict[str, Callable[[], Frames]] = {
    "empty maps": lambda: many(b"\x80", FULL),
    "empty arrays": lambda: many(b"\x90", FULL),
    "empty maps in small arrays": lambda: many(b"\x9f" + b"\x80" * 15, FULL // 16),
    "nothing, very often": lambda: many(b"\xc0", FULL),
    "short texts": lambda: many(b"\xa2\xc3\xa9", FULL // 3),
    "pairs": lambda: message(map32(FULL // 2, b"\x01\xc0" * (FULL // 2))),
    "arrays in arrays": lambda: message(b"\x91" * FULL),
    "maps in maps": lambda: message(b"\x81\xc0" * (FULL // 2)),
    "few arrays in arrays": lambda: message(b"\x91" * 5000),
    "claims in claims": lambda: nested_claims(b"\xdd", FULL),
    "few claims in claims": lambda: nested_claims(b"\xdd", 16 * 1024),
    "few map claims in claims": lambda: nested_claims(b"\xdf", 16 * 1024),
    "claimed array": lambda: message(array32(2**32 - 1, b"\xc0")),
    "claimed map": lambda: message(map32(2**32 - 1, b"\xc0")),
    "claimed text": lambda: message(b"\xdb\xff\xff\xff\xff"),
    "claimed bytes": lambda: message(b"\xc6\xff\xff\xff\xff"),
    "claimed extension": lambda: message(b"\xc9\xff\xff\xff\xff\x01"),
    "claimed document": lambda: [b"\xff\xff\xff\xff\xc0"],
    "extensions": lambda: many(b"\xd4\x10\x00", FULL // 3),
    "heads without arrays": lambda: many(b"\xc7\x00\x10", ITEMS),
    "timestamps": lambda: many(b"\xd6\xff\x00\x00\x00\x00", ITEMS),
    "one long text": lambda: message(b"\xdb" + struct.pack(">I", FULL) + b"x" * FULL),
    "one huge integer": lambda: message(extension(3, bytes(FULL - 100))),
    "strings two gigabytes wide": lambda: message(
        extension(1, b"\x0e\x01" + struct.pack("<IQ", 500_000_000, 1))
    ),
    "bytes two gigabytes wide": lambda: message(
        extension(1, b"\x0f\x01" + struct.pack("<IQ", 2_000_000_000, 1))
    ),
    "claimed elements": lambda: message(extension(1, b"\x0a\x81" + struct.pack("<Q", 2**39)), b""),
    "claimed elements of an object array": lambda: packed([ext(21, struct.pack("<Q", 2**39))]),
    "shape whose product overflows": lambda: message(
        extension(1, b"\x0a\x02" + struct.pack("<QQ", 2**32, 2**32)), bytes(64)
    ),
    "empty array of absurd shape": lambda: message(
        extension(1, b"\x0a\x03" + struct.pack("<QQQ", 2**62, 0, 2**62))
    ),
    "empty array of many rows": lambda: message(
        extension(1, b"\x0a\x02" + struct.pack("<QQ", 2**40, 0))
    ),
    "empty object array of many rows": lambda: packed([ext(21, struct.pack("<QQ", 2**40, 0))]),
    "empty arrays of many rows together": lambda: many(
        extension(1, b"\x0a\x02" + struct.pack("<QQ", 1000, 0)), 300
    ),
    "frames": lambda: [*message(b"\xc0"), *[b""] * 100_000],
    "same key": lambda: message(map32(ITEMS // 2, b"\xa1a\xc0" * (ITEMS // 2))),
    "colliding integers": colliding_integers,
    "colliding tuples": colliding_tuples,
    "integer keys": lambda: message(
        map32(90000, b"".join(b"\xce" + struct.pack(">I", key) + b"\xc0" for key in range(90000)))
    ),
    "pickles": lambda: many(extension(5, b"x" * 30), ITEMS),
}  # fmt: skip
ACCEPTED: dict[str, Callable[[], Frames]] = {
    "as many empty maps as may be": lambda: many(b"\x80", ITEMS),
    "as many empty sets as may be": lambda: many(b"\x91\xc7\x00\x11", ITEMS // 2),
    "as many empty arrays as may be": lambda: many(
        extension(1, b"\x0a\x01" + bytes(8)), ITEMS
    ),
    "as many empty object arrays as may be": lambda: many(
        b"\x91" + extension(21, bytes(8)), ITEMS // 2
    ),
    "as many scalars as may be": lambda: many(extension(2, b"\x0a" + bytes(4)), ITEMS),
    "as many big integers as may be": lambda: many(extension(3, b"\x7f" * 1024), FULL // 1032),
    "wide texts": lambda: many(
        b"\xdb" + struct.pack(">I", 4 * MIB - 64) + b"x" * (4 * MIB - 68) + "\U0001f600".encode(), 1
    ),
    "descriptions full of escapes": lambda: many(
        b"\x93\xc7\x00\x19\xd9\xff" + b"\x1b" * 255 + b"\xda\x04\x00" + b"\x1b" * 1024,
        FULL // 1288 // 4,
    ),
    "collisions in small maps": colliding_in_small_maps,
}  # fmt: skip
BOMBS = REFUSED | ACCEPTED


def main() -> None:
    plain = sys.argv[1:] == ["plain"]
    for name in list(BOMBS)[: 1 if plain else None]:
        frames = BOMBS[name]()
        if (child := os.fork()) == 0:
            before = status_bytes("VmRSS")
            limit_resources(status_bytes("VmSize") + ADDRESS_SPACE)
            outcome = explode(frames, plain)
            peak = status_bytes("VmHWM") - before
            print(json.dumps({"name": name, "outcome": outcome, "peak": peak}), flush=True)
            os._exit(0)
        os.waitpid(child, 0)


def status_bytes(field: str) -> int:
    with open("/proc/self/status") as file:
        line = next(line for line in file if line.startswith(field))
    return int(line.split()[1]) * 1024


def explode(frames: Frames, plain: bool) -> str:
    """Returns what came of decoding: "decoded", or the name and text of the error."""
    try:
        msgpack.unpackb(frames[0][4:]) if plain else decode(frames)
    except (RemoteProtocolError, MemoryError) as error:
        return f"{type(error).__name__}: {error}"
    return "decoded"


def limit_resources(most: int) -> None:
    """Caps the address space of this process, and the CPU time that it takes from now on."""
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime) + CPU_S
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.RLIM_INFINITY))


if __name__ == "__main__":
    main()
