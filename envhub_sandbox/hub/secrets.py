"""Recognises files that may have keys, tokens or passwords by their names."""

from __future__ import annotations

import fnmatch
import re
from pathlib import Path

from envhub_sandbox.system.platform import homes_of

_KEYS = """
    */.ssh/* */.gnupg/* */.password-store/* */id_rsa* */id_dsa* */id_ecdsa* */id_ed25519*
    *_rsa *_ed25519 *.pem *.key *.ppk *.p12 *.pfx *.jks *.keystore *.kdbx
"""
_LOGINS = """
    */.env */.env.* */.netrc */_netrc */.git-credentials */.npmrc */.pypirc */.pgpass */.my.cnf
    */.s3cfg */.boto */.vault-token */.dockercfg */.docker/config.json */.kube/config */kubeconfig
    *.kubeconfig */.aws/credentials */.aws/config */.aws/sso/* */.azure/*token* */.config/gcloud/*
    */.config/gh/hosts.yml */.cargo/credentials* */huggingface/token */huggingface/stored_tokens
    */kaggle.json */credentials.json */client_secret*.json */service-account*.json
    */service_account*.json */.streamlit/secrets.toml */.modal.toml
"""
_HARMLESS = "*.pub *.py *cacert.pem */.env.example */.env.sample */.env.template */.env.dist"
_BARE_KEY = r"(?s:.*/id_[^./]+)\Z"
"""Further names of keys, such as ``id_work``; a name with a suffix is not a key."""


def _any_of(names: str, *expressions: str) -> re.Pattern[str]:
    return re.compile("|".join([*map(fnmatch.translate, names.split()), *expressions]))


_SECRET = _any_of(_KEYS + _LOGINS, _BARE_KEY)
_NOT_SECRET = _any_of(_HARMLESS)


def looks_secret(path: str) -> bool:
    """Whether a file may have keys or logins, by its path with ``/``."""
    name = f"/{path.lower()}"
    return _SECRET.match(name) is not None and _NOT_SECRET.match(name) is None


def is_home(folder: Path) -> bool:
    """Whether a folder (a path without links) is, or contains, the home of its owner or of the
    caller.
    """
    return any(home.is_relative_to(folder) for home in homes_of(folder))
