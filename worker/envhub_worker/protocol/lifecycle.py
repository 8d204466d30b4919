"""The life of one environment as the client sees it: a table. A missing key is an illegal move."""

from __future__ import annotations

from enum import Enum


class State(Enum):
    """The state of an environment; the value is the text for users."""

    IDLE = "not started"
    READY = "ready"
    PENDING = "waiting for a reply"
    REVIVING = "restarting processes that died"
    LATE = "waiting for a late reply"
    EXPIRED = "ended because it was idle"
    DEAD = "dead"
    FOREIGN = "owned by the process that this one was forked from"
    CLOSED = "closed"

    __hash__ = object.__hash__  # members are singletons; Enum's own hash is slow in Python


class Event(Enum):
    """An event in the life of an environment; the value describes it."""

    START = "the environment was built in a jail"
    SUBMIT = "a request is about to be sent"
    REPLY = "the reply has arrived"
    TIMEOUT = "the deadline passed before the reply arrived"
    INTERRUPT = "an interrupt ended the wait for the reply"
    LOSS = "some processes died and will be restarted"
    REVIVAL = "new processes have replaced the dead ones"
    EXPIRY = "the server ended the jail because it was idle"
    DEATH = "the jail died or was ended for breaking the protocol"
    FORGET = "the jail was given up"
    FORK = "this process is a fork of the environment's process"
    CLOSE = "the environment was closed"

    __hash__ = object.__hash__


TABLE: dict[tuple[State, Event], State] = {
    (State.IDLE, Event.START): State.READY,
    (State.IDLE, Event.CLOSE): State.CLOSED,
    (State.READY, Event.SUBMIT): State.PENDING,
    # Found out without a request, by a look at the jail before a reset.
    (State.READY, Event.DEATH): State.DEAD,
    (State.READY, Event.FORGET): State.IDLE,
    (State.READY, Event.CLOSE): State.CLOSED,
    (State.PENDING, Event.REPLY): State.READY,
    (State.PENDING, Event.TIMEOUT): State.LATE,
    (State.PENDING, Event.INTERRUPT): State.LATE,
    (State.PENDING, Event.DEATH): State.DEAD,
    (State.PENDING, Event.CLOSE): State.CLOSED,
    (State.PENDING, Event.LOSS): State.REVIVING,
    (State.READY, Event.EXPIRY): State.EXPIRED,
    (State.PENDING, Event.EXPIRY): State.EXPIRED,
    (State.EXPIRED, Event.EXPIRY): State.EXPIRED,
    (State.EXPIRED, Event.FORGET): State.IDLE,
    (State.EXPIRED, Event.CLOSE): State.CLOSED,
    (State.REVIVING, Event.REVIVAL): State.READY,
    (State.REVIVING, Event.TIMEOUT): State.LATE,
    (State.REVIVING, Event.INTERRUPT): State.LATE,
    (State.REVIVING, Event.DEATH): State.DEAD,
    (State.REVIVING, Event.CLOSE): State.CLOSED,
    # Only a reset may follow LATE: it takes the late reply, or gives the jail up.
    (State.LATE, Event.REPLY): State.READY,
    (State.LATE, Event.DEATH): State.DEAD,
    (State.LATE, Event.FORGET): State.IDLE,
    (State.LATE, Event.CLOSE): State.CLOSED,
    # At the cost of one restart, if the policy permits any.
    (State.DEAD, Event.FORGET): State.IDLE,
    (State.DEAD, Event.CLOSE): State.CLOSED,
    (State.FOREIGN, Event.CLOSE): State.CLOSED,
    **{(state, Event.FORK): State.FOREIGN for state in State if state is not State.CLOSED},
}


class Lifecycle:
    """A state and its legal moves.

    Attributes:
        request: The request that has no answer yet. None in ``LATE``, where nobody knows how far
            the worker came with it.
    """

    request: str | None = None

    def __init__(self) -> None:
        self.state = State.IDLE

    @property
    def closed(self) -> bool:
        """Whether the environment is closed."""
        return self.state is State.CLOSED

    def answered(self) -> None:
        """The reply has come."""
        self.request = None
        if self.state is not State.CLOSED:  # as moved, which a step need not call
            self.on(Event.REPLY)

    def moved(self, event: Event) -> None:
        """Like ``on``, but does nothing if another thread or a signal handler has closed it."""
        if self.state is not State.CLOSED:
            self.on(event)

    def on(self, event: Event) -> State:
        """Moves to the state that the table has for ``event``.

        Raises:
            RuntimeError: The move is illegal; that is a defect of this package.
        """
        following = TABLE.get((self.state, event))
        if following is None:
            raise RuntimeError(f"no move from {self.state.name} on {event.name}")
        self.state = following
        return following
