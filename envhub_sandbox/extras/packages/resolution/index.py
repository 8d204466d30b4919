"""Decides where packages come from: by the user's settings for uv, or else for pip.

This module builds uv's environment name by name. The user's variables choose index, proxy,
certificates and cache; no variable that permits builds gets through. Users behind a mirror usually
configure pip; uv takes over what they have not configured for uv.
"""

from __future__ import annotations

import configparser
import os
import re
import site
import sys
from collections.abc import Mapping
from pathlib import Path

from envhub_sandbox.system.platform import own_variables

_KEPT = re.compile(
    r"HOME|USER|LOGNAME|PATH|TMPDIR|LANG|LC_.*|XDG_CACHE_HOME|XDG_DATA_HOME|XDG_RUNTIME_DIR|NETRC"
    r"|SSL_CERT_FILE|SSL_CERT_DIR|SSL_CLIENT_CERT|REQUESTS_CA_BUNDLE"
    r"|(?i:http_proxy|https_proxy|all_proxy|no_proxy)"
    r"|UV_(DEFAULT_INDEX|INDEX|INDEX_URL|EXTRA_INDEX_URL|FIND_LINKS|NO_INDEX|INDEX_STRATEGY"
    r"|INDEX_[A-Z0-9_]+_(USERNAME|PASSWORD)|KEYRING_PROVIDER|INSECURE_HOST|NATIVE_TLS|SYSTEM_CERTS"
    r"|CACHE_DIR|OFFLINE|HTTP_TIMEOUT|HTTP_CONNECT_TIMEOUT|HTTP_RETRIES|REQUEST_TIMEOUT"
    r"|CONCURRENT_(DOWNLOADS|INSTALLS)|EXCLUDE_NEWER|TORCH_BACKEND"
    r"|PYTHON_INSTALL_DIR|PYTHON_INSTALL_MIRROR|PYTHON_DOWNLOADS_JSON_URL)"
)
_CHOOSE_AN_INDEX = (
    *("UV_DEFAULT_INDEX", "UV_INDEX", "UV_INDEX_URL", "UV_EXTRA_INDEX_URL", "UV_FIND_LINKS"),
    "UV_NO_INDEX",
)
_PATHS = (
    *("UV_CACHE_DIR", "SSL_CERT_FILE", "SSL_CERT_DIR", "SSL_CLIENT_CERT", "REQUESTS_CA_BUNDLE"),
    "NETRC",
)
_DEFAULTS = {"UV_HTTP_CONNECT_TIMEOUT": "5"}
"""uv tries four times: an index that cannot be reached is an error after half a minute."""
_FIXED = {"UV_PYTHON_DOWNLOADS": "never", "UV_NO_PROGRESS": "1", "NO_COLOR": "1"}
_YES = ("1", "true", "yes", "on")


def environment(variables: Mapping[str, str] | None = None) -> dict[str, str]:
    """Builds uv's environment from the user's variables (default: this process's)."""
    env = os.environ if variables is None else variables
    kept = {name: value for name, value in env.items() if value and _KEPT.fullmatch(name)}
    if not any(name in kept for name in _CHOOSE_AN_INDEX):
        kept |= _as_uv_says(pip_settings(env), kept)
    ours = {name: _from_here(name, value) for name, value in kept.items()}
    return own_variables() | _DEFAULTS | ours | _FIXED


def _from_here(name: str, value: str) -> str:
    """Makes a path absolute, since uv runs in another folder."""
    if name == "UV_FIND_LINKS":
        return ",".join(map(_absolute, value.split(",")))
    return _absolute(value) if name in _PATHS else value


def _absolute(place: str) -> str:
    return place if not place or "://" in place else os.path.abspath(os.path.expanduser(place))


def uv_cache() -> Path:
    """Returns the folder where uv keeps and unpacks downloads."""
    variables = environment()
    home = variables.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(variables.get("UV_CACHE_DIR") or os.path.join(home, "uv"))


def is_chosen() -> bool:
    """Tells whether the user has named an index."""
    variables = environment()
    return any(name in variables for name in _CHOOSE_AN_INDEX)


def options() -> tuple[str, ...]:
    """Returns options for uv's command line: no variable of uv's turns the index off."""
    return ("--no-index",) if environment().get("UV_NO_INDEX", "").lower() in _YES else ()


def places() -> list[str]:
    """Returns the settings for the source of packages as ``NAME=value``; may include passwords."""
    variables = environment()
    names = (*_CHOOSE_AN_INDEX, "UV_INDEX_STRATEGY", "UV_EXCLUDE_NEWER", "UV_TORCH_BACKEND")
    return [f"{name}={variables[name]}" for name in names if name in variables]


def pip_settings(variables: Mapping[str, str]) -> dict[str, str]:
    """Returns pip's settings by long names; a variable wins over files, a later file over earlier.

    Skips unreadable files.
    """
    settings: dict[str, str] = {}
    for path in _pip_files(variables):
        parser = configparser.RawConfigParser()
        try:
            parser.read(path, "utf-8")
            sections = [name for name in ("global", "install") if parser.has_section(name)]
            for section in sections:
                settings |= {k.replace("_", "-"): v for k, v in parser.items(section)}
        except (OSError, ValueError, configparser.Error):
            continue
    for name, value in variables.items():
        if name.startswith("PIP_") and value:
            settings[name[4:].lower().replace("_", "-")] = value
    return settings


def _pip_files(variables: Mapping[str, str]) -> list[Path]:
    """Lists files in pip's order: machine, user, environment, and the file in the variable."""
    named = variables.get("PIP_CONFIG_FILE", "")
    if named == os.devnull:
        return []
    home = Path(variables.get("HOME") or os.path.expanduser("~"))
    shared = variables.get("XDG_CONFIG_DIRS") or "/etc/xdg"
    own = Path(variables.get("XDG_CONFIG_HOME") or home / ".config")
    files = [Path(folder, "pip", "pip.conf") for folder in shared.split(os.pathsep) if folder]
    files += [Path("/etc/pip.conf"), home / ".pip/pip.conf", own / "pip/pip.conf"]
    files += [Path(prefix, "pip.conf") for prefix in dict.fromkeys([*site.PREFIXES, sys.prefix])]
    return [*files, Path(named)] if named else files


def _as_uv_says(pip: Mapping[str, str], kept: Mapping[str, str]) -> dict[str, str]:
    variables: dict[str, str] = {}
    if index := pip.get("index-url", "").strip():
        variables["UV_DEFAULT_INDEX"] = index
    if more := pip.get("extra-index-url", "").split():
        variables["UV_INDEX"] = " ".join(more)
        # pip has no first index: it takes the best version among all indexes
        variables["UV_INDEX_STRATEGY"] = kept.get("UV_INDEX_STRATEGY", "unsafe-best-match")
    if links := pip.get("find-links", "").split():
        variables["UV_FIND_LINKS"] = ",".join(links)
    if pip.get("no-index", "").strip().lower() in _YES:
        variables["UV_NO_INDEX"] = "1"
    if (certificate := pip.get("cert", "").strip()) and "SSL_CERT_FILE" not in kept:
        variables["SSL_CERT_FILE"] = certificate
    if hosts := pip.get("trusted-host", "").split():
        variables["UV_INSECURE_HOST"] = " ".join(hosts)
    if proxy := pip.get("proxy", "").strip():
        variables |= {name: proxy for name in ("HTTP_PROXY", "HTTPS_PROXY") if name not in kept}
    return variables
