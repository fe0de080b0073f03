"""Durations as people type them."""

from __future__ import annotations

import re

_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}


def seconds_of(text: str, example: str) -> float:
    """Seconds of a number and a unit, such as 90s, 3m, 1.5h or 7d.

    Args:
        text: what was typed.
        example: one that makes sense here, for the error.

    Raises:
        ValueError: another form.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", text)
    if match is None:
        raise ValueError(f"expected a number and s, m, h or d, such as {example}, got {text!r}")
    return float(match.group(1)) * _SECONDS[match.group(2)]
