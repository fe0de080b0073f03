"""Keeps keys, tokens and signed addresses out of what is stored and logged."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit, urlunsplit

HIDDEN = "REDACTED"

# Names whose values open doors, as whole words of a parameter's name: X-Amz-Signature, access_token, sig, apiKey, ...
_NAME = (
    r"(?:[a-z0-9]+[-_.])*(?:signature|sig|credential|credentials|security[-_]?token|token|access[-_]?token|"
    r"refresh[-_]?token|id[-_]?token|session[-_]?id|api[-_]?key|access[-_]?key|access[-_]?key[-_]?id|accesskeyid|"
    r"awsaccesskeyid|secret[-_]?access[-_]?key|secret[-_]?key|secret|key|password|passwd|passphrase|pwd|auth|"
    r"authorization|jwt|policy|key[-_]?pair[-_]?id|hdnea|hdnts|cookie|cookies)"
)
_SECRET_NAME = re.compile(_NAME, re.IGNORECASE)
# The same for keys of JSON, without those that knobs and results are called too ("key", "policy", "token").
_JSON_NAME = re.compile(
    r"(?:[a-z0-9]+[-_])*(?:password|passwd|passphrase|secret|secret[-_]?key|secret[-_]?access[-_]?key|api[-_]?key|"
    r"access[-_]?key|access[-_]?key[-_]?id|(?:access|refresh|security|session|auth|bearer|id)[-_]?token|credentials?|"
    r"authorization|cookies?)",
    re.IGNORECASE,
)
_URL = re.compile(r"[a-z][a-z0-9+.-]{1,20}://[^\s'\"<>`]+", re.IGNORECASE)
_BEARER = re.compile(r"\b(bearer|basic)\s+(?!REDACTED)[A-Za-z0-9._~+/=-]{8,}", re.IGNORECASE)
_AWS_KEY = re.compile(r"\b(?:AKIA|ASIA)[0-9A-Z]{16}\b")
# "password=..." and "secret_key: ..." in prose; a bare "key" or "policy" is too common a word to be hidden there.
_ASSIGNED = re.compile(
    r"\b((?:[a-z0-9]+[-_])*(?:password|passwd|passphrase|secret|token|api[-_]?key|access[-_]?key|signature|credential)"
    r"(?:[-_]?(?:key|id))?)(['\"]?\s*[=:]\s*['\"]?)(?!REDACTED)[^\s'\"&,;)}\]]+",
    re.IGNORECASE,
)


def redact_url(url: str) -> str:
    """`url` without what opens doors: user and password, and the values of query parameters that sign or authorise.

    Everything else stays byte for byte, so that it still says which video it was. Anything that is not a URL (a path)
    is returned as it is.
    """
    try:
        parts = urlsplit(url)
    except ValueError:
        return url
    if not parts.scheme or "://" not in url:
        return url
    host = parts.netloc.rpartition("@")[2]
    netloc = f"{HIDDEN}@{host}" if "@" in parts.netloc else parts.netloc
    query, fragment = _without_secrets(parts.query), _without_secrets(parts.fragment)
    if (netloc, query, fragment) == (parts.netloc, parts.query, parts.fragment):
        return url
    return urlunsplit((parts.scheme, netloc, parts.path, query, fragment))


def redact(text: str) -> str:
    """`text` with the secrets hidden that it can be seen to hold: in URLs, after `password=` and the like, AWS keys."""
    if "://" in text:
        text = _URL.sub(lambda match: redact_url(match.group()), text)
    text = _BEARER.sub(rf"\1 {HIDDEN}", text)
    text = _AWS_KEY.sub(HIDDEN, text)
    return _ASSIGNED.sub(rf"\1\2{HIDDEN}", text)


def redact_json(value: Any) -> Any:
    """JSON types with every text redacted, and the value of every key that names a secret replaced."""
    if isinstance(value, str):
        return redact(value)
    if isinstance(value, Mapping):
        return {
            key: HIDDEN if item and isinstance(key, str) and _JSON_NAME.fullmatch(key) else redact_json(item)
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [redact_json(item) for item in value]
    return value


def is_secret_name(name: str) -> bool:
    """Whether a parameter of this name carries something that opens doors."""
    return _SECRET_NAME.fullmatch(name) is not None


class RedactSecrets(logging.Filter):
    """Hides secrets in every record that passes; add it to the handlers of a program that logs."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Rewrite the record's message; always let it through."""
        message = record.getMessage()
        hidden = redact(message)
        if hidden != message:
            record.msg, record.args = hidden, None
        return True


def _without_secrets(query: str) -> str:
    pairs = query.split("&")
    return "&".join(_hide(pair) for pair in pairs)


def _hide(pair: str) -> str:
    name, equals, value = pair.partition("=")
    return f"{name}={HIDDEN}" if equals and value and is_secret_name(name) else pair
