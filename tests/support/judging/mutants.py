"""What ``envhub check`` says of honest samples with one fault in them: its check, and no other.

``python -m tests.support.judging.mutants [SAMPLE ...]`` puts each fault into each sample, one after
the other (some ten minutes), prints what is told beyond what the sample itself is told, and ends
with 1 where that is not what stands here.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from envhub_sandbox.check.judge import judge
from envhub_sandbox.check.settings import JudgeOptions
from tests.support.judging.judged import ENTRIES, HONEST
from tests.support.samples import sample

_SLOW_S, _NEVER_S = 0.02, 600.0
# Every class of an environment that is defined from here on, by whomever, has the fault.
_PRELUDE = """
import threading
import time
import gymnasium
import numpy

def first_leaf(value, change):
    if isinstance(value, dict):
        key = next(iter(value))
        return {**value, key: first_leaf(value[key], change)}
    if isinstance(value, tuple):
        return (first_leaf(value[0], change), *value[1:])
    return change(value)

OTHERS = {"float32": "float64", "float64": "float32", "int64": "uint64", "uint8": "uint16"}

def other_type(value):
    value = numpy.asarray(value)
    return value.astype(OTHERS.get(value.dtype.name, "int64"))

def far_off(value):
    value = numpy.asarray(value)
    what = numpy.nan if value.dtype.kind == "f" else numpy.iinfo(value.dtype).max
    return numpy.full_like(value, what)

def faulty(method, name):
    def outermost(self, *args, **kwargs):
        FAULT

    def instead(self, *args, **kwargs):
        if getattr(inside, "it", False):
            return method(self, *args, **kwargs)
        inside.it = True
        try:
            return outermost(self, *args, **kwargs)
        finally:
            inside.it = False
    return instead

inside = threading.local()

def define(cls, **kwargs):
    for name in ("reset", "step"):
        if name in vars(cls):
            setattr(cls, name, faulty(vars(cls)[name], name))

gymnasium.Env.__init_subclass__ = classmethod(define)
"""


@dataclass(frozen=True)
class Fault:
    """One, and by what it is to be told.

    Attributes:
        check: The check.
        body: Of the method that stands in the place of ``reset`` and of ``step``.
        unlike: Samples of which it is not told, and why; or told by another check, which is named.
    """

    check: str
    body: str
    unlike: dict[str, str]

    def told_in(self, sample: str) -> set[str]:
        """The checks that have to find something."""
        if sample not in self.unlike:
            return {self.check}
        check, found, _ = self.unlike[sample].partition(": ")
        return {check} if found else set()


_DRAWS_NOTHING = "nothing of it is drawn by lot"
_BYTES = "every byte is a pixel"
_WHOLE = {"custom_vector": "it is a vector environment, and has no others in it"}
_STEPS_ONLY = "if name == 'reset': return method(self, *args, **kwargs)\n        "
_CALLS = "observation, *rest = method(self, *args, **kwargs)\n        "
FAULTS = {
    "wrong dtype": Fault(
        "observation-dtype",
        _CALLS + "return (first_leaf(observation, other_type), *rest)",
        {
            "duck_typed": "nobody can ask its sub-environments, and Gymnasium casts",
            "exotic_spaces": "any whole numbers are members of a MultiBinary",
            **dict.fromkeys(("brittle", "half_cheetah"), "a float32 is a member of float64"),
            **_WHOLE,
        },
    ),
    "out of its space": Fault(
        "observation-space",
        _CALLS + "return (first_leaf(observation, far_off), *rest)",
        {"minigrid": _BYTES, "pusht": _BYTES, **_WHOLE},
    ),
    "reward that is no number": Fault(
        "rewards", _STEPS_ONLY + _CALLS + "return (observation, float('nan'), *rest[1:])", _WHOLE
    ),
    "unseeded": Fault(
        "seeding",
        "kwargs.pop('seed', 0); return method(self, *args, **kwargs)",
        {
            **dict.fromkeys(("marker", "mo_gymnasium", "src_layout", "sub_folder"), _DRAWS_NOTHING),
            "brittle": "survives: without a seed it has no luck",
            **_WHOLE,
        },
    ),
    "leaked thread": Fault(
        "leaks-threads",
        "if name == 'reset': threading.Thread(target=threading.Event().wait, daemon=True).start()"
        "\n        return method(self, *args, **kwargs)",
        _WHOLE,
    ),
    "slow step": Fault(
        "slow-steps",
        f"if name == 'step': time.sleep({_SLOW_S})\n        return method(self, *args, **kwargs)",
        _WHOLE,
    ),
    "missing requirement": Fault("imports", "return method(self, *args, **kwargs)", {}),
}
_MISSING = "import not_to_be_had\n"


def mutant(name: str, fault: str, folder: Path) -> str:
    """A sample with a fault, as a reference."""
    made = folder / name
    shutil.copytree(sample(name), made, ignore=shutil.ignore_patterns("__pycache__"))
    entry = ENTRIES.get(name, "")
    file = made / (entry.removeprefix(":") or "env.py")
    prelude = _PRELUDE.replace("FAULT", FAULTS[fault].body)
    if FAULTS[fault].check == "imports":
        prelude += _MISSING
    text = file.read_text()
    future = "from __future__ import annotations\n"
    head, found, rest = text.partition(future)
    file.write_text(head + found + prelude + rest if found else prelude + text)
    return f"{made}{entry}"


def told_of(reference: str, fault: str = "") -> set[str]:
    """The checks that find something; how long steps take is asked only where that is the fault."""
    arguments = {"n_envs": 2, "timeouts": dict.fromkeys(("call_s", "reset_s", "step_s"), 60.0)}
    slow_s = _SLOW_S / 2 if fault and FAULTS[fault].check == "slow-steps" else _NEVER_S
    asked = JudgeOptions(
        reference=reference, arguments=arguments, steps=10, resets=2, slow_step_s=slow_s
    )
    return {one.id for one in judge(asked).findings}


def main(names: list[str]) -> int:
    """All faults in all samples, or in those that are named."""
    wrong = 0
    for name in names or HONEST:
        itself = told_of(f"{sample(name)}{ENTRIES.get(name, '')}")
        for fault, what in FAULTS.items():
            with tempfile.TemporaryDirectory(prefix="envhub-mutants-") as folder:
                Path(folder).chmod(0o755)
                found = told_of(mutant(name, fault, Path(folder)), fault) - itself
            expected = what.told_in(name)
            wrong += found != expected
            words = "as expected" if found == expected else "NOT SO"
            print(
                f"{words:12} {name}, {fault}: {', '.join(sorted(found)) or 'nothing'}", flush=True
            )
    print(f"{wrong} are not as they stand here" if wrong else "all so")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
