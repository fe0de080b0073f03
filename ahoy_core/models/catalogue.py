"""Every adapter there is, in one explicit table. Nothing registers itself; a new one is one entry here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.errors import ModelError
from ahoy_core.models.generative_adapters import GENERATIVE
from ahoy_core.models.measure_adapters import MEASURES
from ahoy_core.models.people_adapters import PEOPLE

ADAPTERS: Final[tuple[Adapter, ...]] = (*PEOPLE, *GENERATIVE, *MEASURES)

EMBEDDED: Final = "embedded"
"""What fills a role when nothing is said."""


def roles() -> tuple[str, ...]:
    """Roles that have adapters, in the order of the table."""
    return tuple(dict.fromkeys(adapter.role for adapter in ADAPTERS))


def adapter(role: str, name: str) -> Adapter:
    """The adapter of a role by name.

    Raises:
        ModelError: no such role or adapter; the text lists what there is.
    """
    for each in ADAPTERS:
        if (each.role, each.name) == (role, name):
            return each
    if role not in roles():
        raise ModelError(f"expected a role among {', '.join(roles())}, got {role!r}")
    known = [each.name for each in ADAPTERS if each.role == role]
    raise ModelError(f"expected for the role {role} one of {EMBEDDED}, {', '.join(known)}, got {name!r}")


def check_fills(fills: Mapping[str, Fill]) -> dict[str, Fill]:
    """The fills that are not the embedded default, every name checked.

    Raises:
        ModelError: an unknown role or adapter.
    """
    chosen = {}
    for role, fill in fills.items():
        if fill.fill == EMBEDDED:
            if role not in roles():
                raise ModelError(f"expected a role among {', '.join(roles())}, got {role!r}")
            continue
        adapter(role, fill.fill)
        chosen[role] = fill
    return chosen
