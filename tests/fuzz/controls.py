"""Targets that do what none must: whoever runs the others has to notice. Run only by name."""

import os
import signal
from collections.abc import Callable

from tests.fuzz.oracle import demand
from tests.fuzz.targets import Dice


def control_raises(dice: Dice) -> None:
    """Something that is no error of ours."""
    raise KeyError(dice.rng.random())


def control_harms(dice: Dice) -> None:
    """A lie with an effect."""
    demand(False, "this is a control")


def control_eats(dice: Dice) -> None:
    """More memory than there is."""
    bytearray(1 << 40)


def control_hangs(dice: Dice) -> None:
    """One that no code of Python ends."""
    signal.sigwait({signal.SIGUSR1})


def control_dies(dice: Dice) -> None:
    """As after a read of memory that is not there."""
    os.kill(os.getpid(), signal.SIGSEGV)


CONTROLS: dict[str, Callable[[Dice], None]] = {
    one.__name__: one
    for one in (control_raises, control_harms, control_eats, control_hangs, control_dies)
}
