"""Keeps keys, tokens and signed addresses out of what is stored and logged."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import unquote

HIDDEN = "***"
_MAX_SHOWN = 120  # characters of somebody's text that an error repeats

# Names of an address's parameters whose values open doors: X-Amz-Signature, access_token, sig, apiKey, pass%77ord, ...
_SECRET_NAME = re.compile(
    r"(?:^|[_\-.])(?:access|api|auth\w*|cred\w*|key|keyid|hmac|jwt|pass\w*|pwd|secret|session\w*|sid|sig|sign|signature"
    r"|token|apikey|accesskey|accesskeyid|awsaccesskeyid|policy|hdnea|hdnts|cookies?)(?:$|[_\-.])"
    r"|token$|^x-amz-|^x-goog-|signature|secret|password",
    re.IGNORECASE,
)
# The same for keys of JSON, without those that knobs and results are called too ("key", "policy", "token").
_JSON_NAME = re.compile(
    r"(?:[a-z0-9]+[-_])*(?:password|passwd|passphrase|secret|secret[-_]?key|secret[-_]?access[-_]?key|api[-_]?key|"
    r"access[-_]?key|access[-_]?key[-_]?id|(?:access|refresh|security|session|auth|bearer|id)[-_]?token|credentials?|"
    r"authorization|cookies?)",
    re.IGNORECASE,
)
# The scheme's length is bounded so that a long line costs linear time.
_ADDRESS = re.compile(r"[a-z][a-z0-9+.\-]{0,19}://[^\s'\"<>`]*", re.IGNORECASE)
# In abfs://CONTAINER@ACCOUNT/KEY the part before the @ is no secret.
_USERINFO = re.compile(r"(?<!abfs://)(?<!abfss://)(?<=://)[^/?#\s'\"<>]*@")
_PARAMETER = re.compile(r"(?<=[?&;#])([^=?&;#\s'\"<>]+)=([^&;#\s'\"<>]*)")
# Long and mixed: looks drawn at random, whatever its name.
_RANDOM_VALUE = re.compile(r"(?=.*\d)(?=.*[A-Za-z])[A-Za-z0-9_\-.~+/%=]{24,}")
_BEARER = re.compile(r"\b(bearer|basic)\s+[A-Za-z0-9._~+/=-]{8,}", re.IGNORECASE)
_AWS_KEY = re.compile(r"\b(?:AKIA|ASIA)[0-9A-Z]{16}\b")
# "password=..." and "secret_key: ..." in prose; a bare "key" or "policy" is too common a word to be hidden there.
_ASSIGNED = re.compile(
    r"\b((?:[a-z0-9]+[-_])*(?:password|passwd|passphrase|secret|token|api[-_]?key|access[-_]?key|signature|credential)"
    r"(?:[-_]?(?:key|id))?)(['\"]?\s*[=:]\s*['\"]?)[^\s'\"&,;)}\]]+",
    re.IGNORECASE,
)


def redact_url(url: str) -> str:
    """`url` without what opens doors: what stands before an `@` of the host, and parameters whose name says secret.

    Everything else stays byte for byte: what is stored is opened again. What is no address (a path) is returned as it
    is.
    """
    return _without_secrets(url, guess=False) if _ADDRESS.match(url) else url


def redact(text: str) -> str:
    """`text` for people, with the secrets hidden that it can be seen to hold: in addresses, `password=...`, AWS keys.

    Of addresses, values that look drawn at random are hidden too, whatever their name.
    """
    return _redact(text, guess=True)


def has_secret(url: str) -> bool:
    """Whether an address carries a user name, a password or a parameter whose name says secret."""
    return bool(_USERINFO.search(url)) or any(_is_secret_name(name) for name, _ in _PARAMETER.findall(url))


def shown(text: str) -> str:
    """Somebody's text, fit for a message or a log line: redacted, one line, printable, not too long."""
    # Redact before cutting: half a secret is one, too.
    safe = redact(text)
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in safe[: _MAX_SHOWN + 1])
    return line if len(line) <= _MAX_SHOWN else f"{line[:_MAX_SHOWN]}... ({len(text)} characters)"


def redact_json(value: Any) -> Any:
    """JSON types with every text redacted, and the value of every key that names a secret replaced."""
    if isinstance(value, str):
        return _redact(value, guess=False)
    if isinstance(value, Mapping):
        return {
            key: HIDDEN if item and isinstance(key, str) and _JSON_NAME.fullmatch(key) else redact_json(item)
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [redact_json(item) for item in value]
    return value


class RedactSecrets(logging.Filter):
    """Hides secrets in every record that passes; add it to the handlers of a program that logs."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Rewrite the record's message; always let it through."""
        message = record.getMessage()
        hidden = redact(message)
        if hidden != message:
            record.msg, record.args = hidden, None
        return True


def _redact(text: str, guess: bool) -> str:
    text = _ADDRESS.sub(lambda match: _without_secrets(match.group(), guess), text)
    text = _BEARER.sub(rf"\1 {HIDDEN}", text)
    text = _AWS_KEY.sub(HIDDEN, text)
    return _ASSIGNED.sub(rf"\1\2{HIDDEN}", text)


def _without_secrets(url: str, guess: bool) -> str:
    """An address; with `guess`, values that look like secrets are hidden under any name."""

    def parameter(match: re.Match[str]) -> str:
        name, value = match.groups()
        hide = bool(value) and (_is_secret_name(name) or (guess and _RANDOM_VALUE.fullmatch(value)))
        return f"{name}={HIDDEN if hide else value}"

    return _PARAMETER.sub(parameter, _USERINFO.sub(f"{HIDDEN}@", url))


def _is_secret_name(name: str) -> bool:
    return bool(_SECRET_NAME.search(unquote(name)))
