"""The control: runs one payload in a plain interpreter, next to nothing but the client.
argv: name, arguments as JSON, alias. The first line of stdin is a secret that this process then
holds in its memory, as a trainer that imports the repository would. Prints one line of JSON, and
stays until stdin ends."""

import json
import os
import sys
import traceback

sys.dont_write_bytecode = True  # another test may be reading this folder as a repository
secret = bytearray(sys.stdin.readline().strip(), "ascii")
sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from payloads import running  # noqa: E402

answer = {"value": None, "error": ""}
try:
    answer["value"] = running.run(sys.argv[1], json.loads(sys.argv[2]), sys.argv[3])
except BaseException:
    answer["error"] = traceback.format_exc()
print("\n" + json.dumps(answer, default=repr), flush=True)
sys.stdin.read()
os._exit(0)
