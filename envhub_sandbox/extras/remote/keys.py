"""Addresses of servers on other hosts, and the keys by which client and server authenticate."""

from __future__ import annotations

import ipaddress
import os
import re
from pathlib import Path
from urllib.parse import urlsplit

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError
from envhub_sandbox.hub.logins import without_login
from envhub_worker.protocol.keys import parse_key

SERVER_KEY_VARIABLE = "ENVHUB_SERVER_KEY"
CLIENT_KEY_VARIABLE = "ENVHUB_CLIENT_KEY"
CONFIG_VARIABLE = "ENVHUB_CONFIG"
_HOST = re.compile(r"[a-z0-9_.:%;-]+")
"""Host names that ZeroMQ accepts; its errors about other names do not say the endpoint."""
_MAX_FILE_CHARACTERS = 1 << 20


def address_of(endpoint: str) -> str:
    """Return the ``host:port`` of an endpoint. Raises ``PolicyError``: it is not ``tcp://...``."""
    if "@" in endpoint:
        raise PolicyError(
            "sandbox: a remote server identifies clients by their keys; leave out the login "
            f"before the @: {without_login(endpoint)!r}"
        )
    try:
        parts = urlsplit(endpoint)
        host, port = parts.hostname or "", parts.port
        is_whole = endpoint == f"tcp://{parts.netloc}"
    except ValueError:
        host, port, is_whole = "", None, False
    if not (port and is_whole and _HOST.fullmatch(host)):
        raise PolicyError(f"sandbox is {endpoint!r}; a remote server is tcp://HOST:PORT")
    return f"{host}:{port}"


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint names a loopback address."""
    host = urlsplit(endpoint).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def config_folder() -> Path:
    """Return ``$ENVHUB_CONFIG``, or the user's configuration folder for ``envhub-sandbox``."""
    chosen = os.environ.get(CONFIG_VARIABLE)
    if chosen:
        return Path(chosen).expanduser().absolute()
    import platformdirs

    return Path(platformdirs.user_config_dir("envhub-sandbox", appauthor=False))


def server_key(endpoint: str, given: str | None) -> bytes:
    """Find a server's public key: the argument, the environment variable, or ``known_hosts``.
    Raises ``SandboxUnavailableError``: it is in none of these; ``PolicyError``: it is invalid.
    """
    text = given or os.environ.get(SERVER_KEY_VARIABLE) or _known(address_of(endpoint))
    if not text:
        raise SandboxUnavailableError(
            f"the public key of {endpoint} is not known, and without it another program could "
            "imitate that server. It prints its key when it starts: write it after the address, "
            f"as in '{endpoint} KEY', set {SERVER_KEY_VARIABLE}, or write "
            f"'{address_of(endpoint)} KEY' into {config_folder() / 'known_hosts'}"
        )
    return _parsed(text, "server_key")


def _known(address: str) -> str | None:
    for line in _read(config_folder() / "known_hosts", "known_hosts").splitlines():
        words = line.split()
        if len(words) == 2 and words[0] == address:
            return words[1]
    return None


def _read(path: Path, what: str) -> str:
    """Read a file of keys; empty if there is no file.
    Raises ``PolicyError``: the file cannot be read, or is too large.
    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            text = file.read(_MAX_FILE_CHARACTERS + 1)
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except (OSError, ValueError) as error:  # ValueError: the name has a null character
        raise PolicyError(f"{what}: {error}") from error
    if len(text) > _MAX_FILE_CHARACTERS:
        raise PolicyError(f"{what}: {path} is larger than {_MAX_FILE_CHARACTERS >> 20} MiB")
    return text


def is_key_file(key: str | os.PathLike[str] | None) -> bool:
    """Whether a text names a key's file, and is not the key itself."""
    if not isinstance(key, str):
        return key is not None
    try:
        parse_key(key)
    except ValueError:
        return os.sep in key  # without a separator it may be a mistyped key
    return False


def client_key(given: str | os.PathLike[str] | None) -> bytes:
    """Find the client's secret key: argument, variable or file; raises as ``server_key``."""
    default = config_folder() / "client.key"
    named = given or os.environ.get(CLIENT_KEY_VARIABLE) or default
    if not is_key_file(named) and not _is_file(named):
        return _parsed(os.fspath(named), "client_key")
    if text := _read(Path(os.path.expanduser(named)), "client_key"):
        return _parsed(text, "client_key")
    if named is not default:  # the error leaves the text out, because it may be a mistyped key
        raise PolicyError("client_key: it names a file that is empty or not there, or is no key")
    raise SandboxUnavailableError(
        "a remote server accepts only clients with a listed key, and this client has no key: "
        f"run 'envhub-worker keygen --out {default.parent}' and give the public key to the "
        f"server's --authorized-clients, or set {CLIENT_KEY_VARIABLE} to the key that the "
        "server printed"
    )


def _is_file(text: str | os.PathLike[str]) -> bool:
    try:
        return os.path.isfile(text)
    except ValueError:  # the text has a null character
        return False


def _parsed(text: str, what: str) -> bytes:
    try:
        return parse_key(text)
    except ValueError as error:
        raise PolicyError(f"{what}: {error}") from None
