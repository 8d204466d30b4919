"""The jail's end of the fast lane: steps out of one slab into another, at the ring of a doorbell.

Followed: ``eventfd(2)``, ``memfd_create(2)``. The request slab is mapped read-only (the client has
sealed it against our writes); the reply slab belongs to both.
"""

from __future__ import annotations

import contextlib
import mmap
import os
from dataclasses import replace
from time import perf_counter_ns
from typing import Any

from envhub_worker.jail.failure import raised
from envhub_worker.jail.infos import InfoWriter, Pairs, join
from envhub_worker.jail.subenvs import SubEnvs
from envhub_worker.protocol import messages as m
from envhub_worker.protocol import slabs

_RING = (1).to_bytes(8, "little")


class Lane:
    """One environment's steps.

    Args:
        env: Its sub-environments.
        layout: Where everything lies.
        fds: Request slab, reply slab, our doorbell, the client's. Owned from now on.
    """

    def __init__(self, env: SubEnvs, layout: slabs.Layout, fds: list[int]) -> None:
        request, reply, self.bell, self._client_bell = fds
        self._request = mmap.mmap(request, layout.request_bytes, prot=mmap.PROT_READ)
        self._reply = mmap.mmap(reply, layout.reply_bytes)
        os.close(request)
        os.close(reply)
        os.set_blocking(self.bell, False)
        self._asked = slabs.words(self._request)
        self._told = slabs.words(self._reply)
        self._layout = layout
        self._env = env
        self._assemble = slabs.assembler(env.single_action_space)
        self._served = 0
        self._views: dict[tuple[int, int], Any] = {}
        self._pairs: Pairs = []
        self._writer = InfoWriter(self._reply, layout.infos, layout.count)
        env.batch.move(layout, self._reply)

    def rest(self) -> None:
        """Before sleeping: ask for the doorbell, and serve what came in the meantime."""
        self._told[slabs.PARKED] = 1
        self.serve()

    def wake(self) -> None:
        """After the doorbell: silence it, and serve while requests keep coming quickly."""
        with contextlib.suppress(BlockingIOError):
            os.read(self.bell, 8)
        self._told[slabs.PARKED] = 0
        while self.serve() and self._wait_awake():
            pass

    def _wait_awake(self) -> bool:
        budget = self._asked[slabs.SPIN]
        if not budget:
            return False
        asked, served, until = self._asked, self._served, perf_counter_ns() + budget
        while asked[slabs.SEQUENCE] == served:
            if perf_counter_ns() > until:
                return False
        return True

    def serve(self) -> bool:
        """Serve a request if there is one."""
        sequence = self._asked[slabs.SEQUENCE]
        if sequence == self._served:
            return False
        told = self._told
        told[slabs.OUTCOME], told[slabs.LENGTH] = self._run()
        self._served = sequence
        told[slabs.SEQUENCE] = sequence
        if self._asked[slabs.PARKED]:
            os.write(self._client_bell, _RING)
        return True

    def _run(self) -> tuple[int, int]:
        try:
            pairs = self._pairs = self._env.run_step(self._actions())
            return self._writer.write(pairs) if pairs else (slabs.DONE, 0)
        except BaseException as error:
            return slabs.RAISED, self._writer.put(_raised_frame(error))

    def infos(self) -> dict[Any, Any]:
        """The last step's infos."""
        return join(self._pairs, self._layout.count)

    def _actions(self) -> Any:
        # copied, because an environment may keep its action and the client writes the next one
        leaves = [self._view(index).copy() for index in range(len(self._layout.actions))]
        return self._assemble(leaves)

    def _view(self, index: int) -> Any:
        code = self._asked[slabs.DTYPES + index]
        found = self._views.get((index, code))
        if found is None:
            leaf = self._layout.actions[index]
            found = slabs.view(self._request, leaf, slabs.ACTION_DTYPES[code])
            self._views[index, code] = found
        return found


def _raised_frame(error: BaseException) -> Any:
    """The encoded exception; without its traceback where that does not fit."""
    message = raised(error, "step")
    [frame] = m.pack(message, 0)
    if len(frame) > slabs.INFO_BYTES:
        [frame] = m.pack(replace(message, traceback=""), 0)
    return frame
