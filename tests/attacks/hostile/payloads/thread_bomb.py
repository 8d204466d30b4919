"""Start threads, and have them stay."""

import threading

kept = []


def attack(count):
    for _ in range(count):
        thread = threading.Thread(target=threading.Event().wait, args=(300,), daemon=True)
        thread.start()
        kept.append(thread)
    return len(kept)
