"""Search all of this process's memory for something that looks like the token.

A fork of the client would hold it, however well its environment was scrubbed.
"""

import os
import re


def attack(prefix):
    pattern = re.compile(prefix.encode() + rb"[0-9a-f]{32}")
    found = set()
    memory = os.open("/proc/self/mem", os.O_RDONLY)
    with open("/proc/self/maps") as maps:
        areas = [line.split() for line in maps]
    for words in areas:
        start, end = (int(edge, 16) for edge in words[0].split("-"))
        if "r" not in words[1] or end - start > 1 << 30:
            continue
        try:
            data = os.pread(memory, end - start, start)
        except OSError:
            continue
        found.update(match.decode() for match in pattern.findall(data))
    return sorted(found)
