"""Which model fills each role on this machine: `roles.yaml`, read once, loaded when a stage first asks.

A choice is a machine's, not a batch's: paths and commands are only true where the files are, and a batch's manifest,
which comes from a shared store, must not be able to name a program. Keys know a model by the contents of its files, so
machines that are set up alike make the same artifacts, and others don't mix with them.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import yaml
from pydantic import TypeAdapter, ValidationError

from ahoy_core.body.load import PACKAGED
from ahoy_core.models import shelf
from ahoy_core.models.adapter import OWN_WEIGHTS, Fill
from ahoy_core.models.catalogue import adapter, check_fills
from ahoy_core.models.checkpoint import device_of
from ahoy_core.models.errors import ModelError
from ahoy_core.models.hashes import sha256_of
from tasks.role import Role

ENVIRONMENT: Final = "AHOY_ROLES"
"""Path of a `roles.yaml`, or its text (JSON is YAML)."""


@dataclass(frozen=True)
class Fills:
    """Roles that something else than the embedded default fills.

    Attributes:
        chosen: role -> who.
    """

    chosen: Mapping[str, Fill] = field(default_factory=dict)

    def get(self, role: str) -> Any:
        """The loaded model of a role, or None where the embedded default fills it.

        Raises:
            ModelError: it cannot be loaded; the text says why and what to do.
        """
        if role not in self.chosen:
            return None
        fill = self.chosen[role]
        return _opened(role, fill.model_dump_json(), _weights_hash(fill, adapter(role, fill.fill).companions(fill)))

    def role(self, role: str) -> Role | None:
        """Who fills a role, for keys, reports and metric rows; None for the embedded default.

        Raises:
            ModelError: its files are not there.
        """
        if role not in self.chosen:
            return None
        fill = self.chosen[role]
        declared = adapter(role, fill.fill)
        declared.require(fill)
        title = declared.title + (OWN_WEIGHTS if fill.own_weights else "")
        return Role(title, declared.licence, _identity(fill, declared.companions(fill)))

    def filled(self, defaults: Mapping[str, Role], fillable: tuple[str, ...]) -> dict[str, Role]:
        """A stage's roles, with those that are filled otherwise replaced or added."""
        own = {role: found for role in fillable if (found := self.role(role)) is not None}
        return {**defaults, **own}

    def slots(self, fillable: tuple[str, ...]) -> tuple[str, ...]:
        """Scarce resources that a stage's fills need one slot each of: `gpu`, where one of them works on a GPU.

        Raises:
            ModelError: a GPU is asked for where there is none.
        """
        used = [self.chosen[role] for role in fillable if role in self.chosen]
        # Commands bring devices of their own, of which we know nothing but what is said.
        busy = any(f.device.startswith("cuda") if f.command else device_of(f).type == "cuda" for f in used)
        return ("gpu",) if busy else ()

    def body(self, said: str) -> str:
        """The body's name or file: what a run's settings say, else what `roles.yaml` says."""
        fill = self.chosen.get("body")
        if said != PACKAGED or fill is None:
            return said
        adapter("body", fill.fill).require(fill)
        return str(fill.path)

    def preload(self) -> list[str]:
        """Read models for a process that others are forked from; returns their roles.

        Those of the CPU are shared as they are. A GPU's context does not survive a fork: its networks are read into
        the CPU's memory, and each fork that uses them copies them to its GPU. All files are hashed here, once.

        Raises:
            ModelError: one cannot be loaded, or its files are not there.
        """
        fills = {role: fill for role, fill in self.chosen.items() if not fill.command and fill.warm}
        for role, fill in fills.items():
            if device_of(fill).type == "cpu":
                self.get(role)
            else:
                with shelf.filling():
                    adapter(role, fill.fill).open(fill)
        self.filled({}, tuple(self.chosen))
        return list(fills)

    def to_json(self) -> str:
        """Text for `ENVIRONMENT` in another process."""
        return json.dumps(
            {role: fill.model_dump(mode="json", exclude_defaults=True) for role, fill in self.chosen.items()}
        )


def read_fills(text: str) -> Fills:
    """Fills of a `roles.yaml`: a mapping from role to the fields of `Fill`.

    Raises:
        ModelError: it is no such mapping, or names a role, an adapter or a field that there is not.
    """
    try:
        said = yaml.safe_load(text) or {}
        fills = TypeAdapter(dict[str, Fill]).validate_python(said)
    except yaml.YAMLError as error:
        raise ModelError(f"roles.yaml is no YAML: {error}") from None
    except ValidationError as error:
        problems = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise ModelError(f"roles.yaml: {problems}; expected ROLE: {{fill: NAME, path: PATH}}") from None
    return Fills(check_fills(fills))


def fills_from_environment() -> Fills:
    """What `ENVIRONMENT` says; nothing, where it is not set.

    Raises:
        ModelError: it names no file, or see `read_fills`.
    """
    said = os.environ.get(ENVIRONMENT, "").strip()
    if not said or said.startswith("{"):
        return read_fills(said)
    path = Path(said).expanduser()
    if not path.is_file():
        raise ModelError(f"expected {ENVIRONMENT} to name a roles.yaml, got {said!r}: no such file")
    return read_fills(path.read_text(encoding="utf-8"))


def with_flags(fills: Fills, flags: list[str], trust_code: bool) -> Fills:
    """The fills with `ROLE=FILL:PATH` (or `ROLE=embedded`) flags laid over them.

    Raises:
        ModelError: a flag of another form, or see `read_fills`.
    """
    chosen = dict(fills.chosen)
    for flag in flags:
        role, equals, rest = flag.partition("=")
        name, _, path = rest.partition(":")
        if not equals or not name:
            raise ModelError(f"expected ROLE=FILL:PATH, got {flag!r}")
        chosen.pop(role, None)
        chosen |= check_fills({role: Fill(fill=name, path=Path(path) if path else None, trust_code=trust_code)})
    return Fills(chosen)


@lru_cache(maxsize=16)
def _opened(role: str, said: str, weights: str) -> Any:
    """The model, loaded once a process for each version of its files; processes forked from it share its pages."""
    fill = Fill.model_validate_json(said)
    return adapter(role, fill.fill).open(fill)


def _identity(fill: Fill, companions: list[Path]) -> str:
    """What a key knows of a fill: its files' contents, its knobs and its command, never a path or a device."""
    weights = _weights_hash(fill, companions)
    parts = (fill.fill, fill.dtype or "", json.dumps(fill.options, sort_keys=True), *fill.command, weights)
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def _weights_hash(fill: Fill, companions: list[Path]) -> str:
    """Sha256 over names and contents of all files at the path, and of those that are used beside it."""
    if fill.path is None:
        return ""
    files = sorted(p for p in fill.path.rglob("*") if p.is_file()) if fill.path.is_dir() else [fill.path]
    if not fill.path.is_dir():
        files += companions
    root = fill.path if fill.path.is_dir() else fill.path.parent
    total = hashlib.sha256()
    for file in files:
        total.update(f"{file.relative_to(root)}\0{sha256_of(file)}\n".encode())
    return total.hexdigest()
