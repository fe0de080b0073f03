"""Taking credentials out of whatever is shown or stored."""

from __future__ import annotations

import re
from urllib.parse import unquote

HIDDEN = "***"
_MAX_SHOWN = 120  # characters of somebody's text that an error repeats

_SECRET_NAME = re.compile(
    r"(?:^|[_\-.])(?:access|api|auth\w*|cred\w*|key|keyid|hmac|jwt|pass\w*|pwd|secret|session\w*|sid|sig|sign|signature"
    r"|token|apikey|accesskey|policy)(?:$|[_\-.])|token$|^x-amz-|^x-goog-|signature|secret|password",
    re.IGNORECASE,
)
# In abfs://CONTAINER@ACCOUNT/KEY the part before the @ is no secret.
_USERINFO = re.compile(r"(?<!abfs://)(?<!abfss://)(?<=://)[^/?#\s'\"<>]*@")
_PARAMETER = re.compile(r"(?<=[?&;#])([^=?&;#\s'\"<>]+)=([^&;#\s'\"<>]*)")
# The scheme's length is bounded so that a long line costs linear time.
_ADDRESS = re.compile(r"[a-z][a-z0-9+.\-]{0,19}://[^\s'\"<>]*", re.IGNORECASE)
# Long and mixed: looks drawn at random, whatever its name.
_RANDOM_VALUE = re.compile(r"(?=.*\d)(?=.*[A-Za-z])[A-Za-z0-9_\-.~+/%=]{24,}")


def redact(text: str) -> str:
    """Hide user names, passwords and tokens in every address inside `text`; the rest stays as it is.

    Hidden are everything before an `@` of the host, and values of parameters (query and fragment) whose name says
    secret or whose value looks drawn at random.
    """
    return _ADDRESS.sub(lambda match: _redact_address(match.group()), text)


def has_secret(url: str) -> bool:
    """Whether an address carries a user name, a password or a parameter whose name says secret."""
    return bool(_USERINFO.search(url)) or any(_is_secret_name(name) for name, _ in _PARAMETER.findall(url))


def shown(text: str) -> str:
    """Somebody's text, fit for a message or a log line: redacted, one line, printable, not too long."""
    # Redact before cutting: half a secret is one, too.
    safe = redact(text)
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in safe[: _MAX_SHOWN + 1])
    return line if len(line) <= _MAX_SHOWN else f"{line[:_MAX_SHOWN]}... ({len(text)} characters)"


def _redact_address(url: str) -> str:
    return _PARAMETER.sub(_redact_parameter, _USERINFO.sub(f"{HIDDEN}@", url))


def _redact_parameter(match: re.Match[str]) -> str:
    name, value = match.groups()
    hide = bool(value) and (_is_secret_name(name) or _RANDOM_VALUE.fullmatch(value))
    return f"{name}={HIDDEN if hide else value}"


def _is_secret_name(name: str) -> bool:
    return bool(_SECRET_NAME.search(unquote(name)))
