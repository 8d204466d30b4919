"""Tensors of torch, wherever one may come: in values, actions, observations and shared state. They
are tested together and not with each module, because importing torch takes two seconds."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cloudpickle
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_sandbox.errors import DependencyError
from envhub_sandbox.transport import values
from envhub_sandbox.transport.values import framed
from envhub_sandbox.vector.actions import batch_of
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.runner.state.shared_state import SharedState
from envhub_worker.runner.vector_spaces import spaces_of
from tests.support.compare import assert_same
from tests.support.decode import decode

torch = pytest.importorskip("torch")
ROW = spaces.Box(-1, 1, (2,), np.float32)


def through(value: object, **options: Any) -> Any:
    return decode([bytes(frame) for frame in encode(value)], **options)


def test_tensors_arrive_as_tensors_or_arrays() -> None:
    source = [
        torch.arange(6.0, requires_grad=True).reshape(2, 3),
        torch.tensor([1 + 2j]).conj(),
        torch.tensor(True),
        torch.tensor([1.5, -2.0], dtype=torch.bfloat16),
        torch.nn.Parameter(torch.ones(2)),
    ]
    made = through(source, tensors=lambda array, name: (name, array))
    assert [name for name, _ in made] == ["float32", "complex64", "bool", "bfloat16", "float32"]
    arrays: Any = through(source)
    for tensor, array in zip(source, arrays, strict=True):
        wide = tensor.detach().resolve_conj()
        expected = wide.float() if wide.dtype == torch.bfloat16 else wide
        assert_same(expected.numpy(), array)
    assert isinstance(through(torch.eye(2).to_sparse()), RemoteObject)


def test_keys_that_cannot_be_hashed_here_are_described() -> None:
    for key in (torch.zeros(2), (1, torch.zeros(2))):
        assert [type(one) for one in through({key: 1})] == [RemoteObject]
    assert [type(one) for one in through({torch.zeros(2)})] == [RemoteObject]


def test_what_the_caller_hands_over_arrives_as_it_is() -> None:
    tensor = torch.arange(6, dtype=torch.bfloat16).reshape(2, 3)
    frames = m.pack(m.Call(1, "told", (tensor,), {}), pickler=framed)
    arrived = m.unpack([bytes(one) for one in frames], unpickler=cloudpickle.loads).args[0]
    assert arrived.dtype is torch.bfloat16
    assert torch.equal(arrived, tensor)


def test_tensors_never_have_a_form() -> None:
    """The same bytes are an array, and a tensor for who asks for one."""
    frames = m.pack(m.Value(torch.zeros(2)))
    for _ in range(3):
        assert type(m.unpack(frames).value) is np.ndarray
    made = m.unpack(frames, tensors=lambda array, name: (name, array))
    assert made.value[0] == "float32"


def test_actions_may_be_tensors() -> None:
    for dtype in (torch.float32, torch.bfloat16):
        value = torch.ones((2, 2), requires_grad=True, dtype=dtype)
        assert_same(np.ones((2, 2), np.float32), batch_of(ROW, value, 2))


def test_a_first_observation_tells_the_batch_as_an_array_does() -> None:
    def known(**attributes: Any) -> Any:
        observation = torch.zeros(3, 2, requires_grad=True)
        env = SimpleNamespace(num_envs=3, reset=lambda: (observation, {}), **attributes)
        return spaces_of(env, {})

    single = {"single_observation_space": ROW, "single_action_space": ROW}
    assert known(**single, observation_space=ROW, action_space=ROW).action_space == batch_space(
        ROW, 3
    )
    assert known(action_space=ROW).single_observation_space.shape == (2,)


@pytest.mark.parametrize("is_late", [False, True])
def test_a_change_of_its_global_generator_is_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_late: bool
) -> None:
    """It is state that a process has once; also where torch is imported after the first look."""
    if is_late:
        monkeypatch.delitem(sys.modules, "torch")
    reported: list[str] = []
    state = SharedState(str(tmp_path), reported.append)
    state.look_closely()
    monkeypatch.setitem(sys.modules, "torch", torch)
    state.look_closely()
    assert reported == []
    for _ in range(2):
        torch.rand(1)
        state.look_closely()
        assert reported == ["torch"]


def test_broken_torch_is_no_workers_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = m.pack(m.Value(torch.zeros(2, dtype=torch.bfloat16)))
    (tmp_path / "torch.py").write_text("raise RuntimeError('another numpy')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "torch")
    values.installed_torch.cache_clear()
    with pytest.raises(DependencyError, match=r"torch is installed here.*another numpy"):
        values.unpacked(frames)
    monkeypatch.undo()
    arrived = values.unpacked(frames).value
    assert (arrived.dtype, arrived.tolist()) == (torch.bfloat16, [0, 0])
