"""Places of a fleet by their names."""

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import errors
from envhub_sandbox.extras.fleet.fleet import MOST_PLACES, Fleet, places_of
from envhub_sandbox.factory.make_env import sandbox_of
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.sandboxes.sandbox import is_list, may_go_elsewhere, worst_of
from envhub_sandbox.transport.replies import UnreachableError
from envhub_worker.extras.access import keys
from envhub_worker.protocol.keys import key_text


def test_a_fleet_is_no_place_of_another() -> None:
    for nested in (Fleet(["tcp://a:1"]), "tcp://a:1,tcp://b:1", ["tcp://a:1"]):
        places: Any = [nested]
        with pytest.raises(errors.PolicyError, match="cannot be a place of a fleet"):
            Fleet(places).opened(sandbox_of)


@pytest.mark.parametrize(
    ("places", "remote", "said"),
    [
        (None, {}, "places are None"),
        (3, {}, "places are 3"),
        (Path("places"), {}, "places are .*a list"),
        (["tcp://a:1"], {"server": "x"}, "'server'.*server_key"),
        (["tcp://a:1"], {"endpoint": "tcp://b:1", 1: 2}, "'endpoint', 1;"),
    ],
)
def test_what_is_no_fleet_says_what_is_one(places: Any, remote: Any, said: str) -> None:
    """When it is made, and before anything is started."""
    with pytest.raises(errors.PolicyError, match=said):
        Fleet(places, remote)


def test_a_secret_key_is_in_copies_and_in_no_pickle() -> None:
    pair = keys.generate()
    text = key_text(pair.secret)
    fleet = Fleet(["tcp://a:1"], remote={"client_key": text})
    for copied in (copy.copy(fleet), copy.deepcopy(fleet)):
        assert copied.remote == {"client_key": text}
    data = pickle.dumps(fleet)
    assert not [one for one in (text.encode(), pair.secret) if one in data]
    assert pickle.loads(data).places == ["tcp://a:1"]
    assert text not in repr(fleet)


def test_places_stand_in_a_list_or_a_text() -> None:
    given = ["tcp://a:1", PROCESS, "tcp://a:1"]
    assert places_of(given) == given
    assert places_of("tcp://a:1 KEY, process,") == ["tcp://a:1 KEY", "process"]
    assert is_list("tcp://a:1,tcp://b:1")
    assert not any(map(is_list, ["process", "docker:image", "tcp://a:1"]))


@pytest.mark.parametrize("source", [[], "", ",", ["process"] * (MOST_PLACES + 1)])
def test_no_places_and_too_many_are_refused(source: Any) -> None:
    with pytest.raises(errors.PolicyError, match=r"a fleet names (0|4097) places"):
        places_of(source)


# --- When another place of a fleet is worth a try, and what is said where none takes a worker


BUSY = errors.ServerBusyError("a: no room")


@pytest.mark.parametrize(
    ("error", "elsewhere"),
    [
        (BUSY, True),
        (UnreachableError("nothing answers"), True),
        (errors.WorkerStartupError("it did not start"), True),
        (errors.WorkerDiedError("lost", reason="connection"), True),
        (errors.WorkerDiedError("ended", reason="server"), True),
        (errors.WorkerTimeoutError("the worker did not answer in time"), True),
        (errors.LoadError("the repository failed"), False),
        (errors.WorkerDiedError("it was killed", reason="signal"), False),
        (errors.WorkerTimeoutError("make_env takes too long", request="make_env"), False),
        (errors.SandboxUnavailableError("the server does not know our key"), False),
        (errors.PolicyError("not permitted"), False),
    ],
)
def test_the_next_follows_a_full_or_absent_one(error: errors.EnvHubError, elsewhere: bool) -> None:
    """What would be the same elsewhere is not tried again, or is a mistake to be known."""
    assert may_go_elsewhere(error) is elsewhere


def test_the_error_for_all_is_one_that_may_pass() -> None:
    """With what each place has said; a single place's error stays as it is."""
    lost = errors.WorkerDiedError("b: lost\nmore of it", reason="connection")
    found = worst_of([lost, BUSY])
    assert found is BUSY
    assert str(found) == "a: no room\nThe other places of the fleet:\nb: lost"
    assert worst_of([lost]) is lost
    assert str(lost) == "b: lost\nmore of it"
