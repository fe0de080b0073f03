"""What an adapter declares of itself, and how a configuration chooses one. Importing this imports no model library."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ahoy_core.models.errors import CheckpointError, MissingPackageError, ModelError, UntrustedCodeError
from ahoy_core.models.hashes import sha256_of

DType = Literal["float32", "bfloat16", "float16"]
DISTRIBUTION = "ahoy-avatars"
OWN_WEIGHTS: Final = ", weights of the user's own"
"""What is put after a model's name where its weights are not the published ones."""


class Fill(BaseModel):
    """Who fills a role: one entry of `roles.yaml`.

    Attributes:
        fill: name of an adapter of that role.
        path: the model's file or folder on the machine that runs it.
        device: "cpu", "cuda", "cuda:1"; "auto" is cuda where there is one.
        dtype: of the weights; by default the adapter's own. States of solvers and results stay float32.
        trust_code: the file at `path` is a program (TorchScript) and may be run.
        own_weights: the files are not those that were published, and are not held against the published hashes; results
            say so.
        command: an external command, as a list of words (no shell reads it).
        timeout_s: seconds that one call of the command may take.
        warm: a worker reads it once, before its runs are forked, and keeps it in the machine's memory for them.
        options: knobs of the adapter.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    fill: str
    path: Path | None = None
    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$")
    dtype: DType | None = None
    trust_code: bool = False
    own_weights: bool = False
    command: tuple[str, ...] = ()
    timeout_s: float = Field(default=3600.0, gt=0)
    warm: bool = True
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _absolute(self) -> Fill:
        if self.path is not None and str(self.path).startswith("~"):
            object.__setattr__(self, "path", self.path.expanduser())
        return self


@dataclass(frozen=True)
class ExpectedFile:
    """A file of a checkpoint.

    Attributes:
        name: relative to the model's folder, or a pattern; "" where `path` is the file itself.
        what: in a few words.
        sha256: where its publisher or a registry states it; a shorter one is a prefix (torchvision's file names).
    """

    name: str
    what: str
    sha256: str = ""


@dataclass(frozen=True)
class Adapter:
    """A model that can fill a role, as a lawyer and an operator need to know it.

    Attributes:
        role: of `ahoy_core.roles`.
        name: what `fill` says.
        title: what reports call it.
        licence: of weights and code, short.
        commercial: whether the licence allows commercial use: "yes", "no", or "conditions" (read it).
        licence_at: where its text is.
        source: where its owner gets the files.
        files: what has to be there.
        beside: what is used if it lies in the folder of the checkpoint's file; part of its hash.
        parameters: billions, as published; 0 where there are none or they are not published.
        dtype: of the weights by default.
        device: "cpu" where a CPU is enough, else "cuda".
        load: "module:function" that takes a `Fill` and returns the role's object.
        extra: of this project that installs what it needs; None where nothing is needed.
        packages: modules that extra brings.
        endings: of the file's name, where the checkpoint is one file.
        is_code: the checkpoint is a program.
        is_command: it runs as an external command.
    """

    role: str
    name: str
    title: str
    licence: str
    commercial: Literal["yes", "no", "conditions"]
    licence_at: str
    source: str
    files: tuple[ExpectedFile, ...]
    load: str
    parameters: float = 0.0
    dtype: DType = "float32"
    device: Literal["cpu", "cuda"] = "cpu"
    extra: str | None = None
    packages: tuple[str, ...] = ()
    endings: tuple[str, ...] = ()
    is_code: bool = False
    is_command: bool = False
    beside: tuple[ExpectedFile, ...] = ()

    @property
    def label(self) -> str:
        """`role=name`, as configurations and messages say it."""
        return f"{self.role}={self.name}"

    def weights_gib(self, dtype: DType | None = None) -> float:
        """Memory of the weights alone: published parameters times the size of one."""
        return self.parameters * 1e9 * (4 if (dtype or self.dtype) == "float32" else 2) / 2**30

    def require(self, fill: Fill) -> None:
        """Refuse what cannot work, before anything heavy is imported.

        Raises:
            MissingPackageError: an optional package is missing.
            CheckpointError: no path, a file that is not there, or one of another hash than was published.
            UntrustedCodeError: the file is a program and nobody said that it may run.
            ModelError: a command is asked for and none is given.
        """
        absent = [name for name in self.packages if importlib.util.find_spec(name) is None]
        if absent:
            raise MissingPackageError(
                f"{self.label} needs {', '.join(absent)}, not installed here; "
                f"pip install '{DISTRIBUTION}[{self.extra}]'"
            )
        if self.is_command and not fill.command:
            raise ModelError(f"{self.label} runs as an external command, got none; add command: [...] to roles.yaml")
        if not self.is_command or fill.path is not None:
            self._require_files(fill)
        if self.is_code and not fill.trust_code:
            raise UntrustedCodeError(
                f"{self.label}: {fill.path} is TorchScript, a program that runs with your rights; if you trust where "
                "it comes from, say trust_code: true in roles.yaml (or --trust-code)"
            )

    def fits(self, path: Path) -> bool:
        """Whether a path looks like this adapter's checkpoint: its names are there, or its ending is the right one."""
        if self.endings:
            return path.is_file() and path.suffix in self.endings
        return path.is_dir() and all(_found(path, file.name) for file in self.files)

    def _require_files(self, fill: Fill) -> None:
        if fill.path is None:
            raise CheckpointError(f"{self.label}: expected a path, got none; {self.how_to_get()}")
        if not fill.path.exists():
            raise CheckpointError(f"{self.label}: nothing is at {fill.path}; {self.how_to_get()}")
        missing = [f.name for f in self.files if f.name and not any(_found(fill.path, f.name))]
        if missing:
            raise CheckpointError(f"{self.label}: {fill.path} lacks {', '.join(missing)}; {self.how_to_get()}")
        if not fill.own_weights:
            self._require_published(fill.path)

    def _require_published(self, path: Path) -> None:
        """Hold those files against their published hashes that have one."""
        for file in (file for file in self.files if file.sha256):
            for found in _found(path, file.name):
                if not (got := sha256_of(found)).startswith(file.sha256):
                    raise CheckpointError(
                        f"{self.label}: expected {found} to have the published sha256 {file.sha256}, got {got}: it is "
                        f"cut short or another file; {self.how_to_get()}; for weights of your own say "
                        "own_weights: true in roles.yaml (or --own-weights)"
                    )

    def companions(self, fill: Fill) -> list[Path]:
        """The files of `beside` that are there, in its order."""
        if fill.path is None:
            return []
        return [found for file in self.beside for found in _found(fill.path, file.name)]

    def hashes(self, fill: Fill) -> dict[str, str]:
        """The checkpoint's files that were looked for, by name: sha256, and whether it is the published one."""
        if fill.path is None:
            return {}
        words = {}
        for file in self.files:
            for found in _found(fill.path, file.name) if file.name else [fill.path]:
                against = "as published" if file.sha256 and not fill.own_weights else "not compared"
                words[found.name] = f"{sha256_of(found)} ({against if file.sha256 else 'none published'})"
        return words | {found.name: f"{sha256_of(found)} (used beside it)" for found in self.companions(fill)}

    def how_to_get(self) -> str:
        """Where the right file is, for the end of an error."""
        return f"get it from {self.source}"

    def open(self, fill: Fill) -> Any:
        """Check what the configuration gives, then load the model.

        Raises:
            ModelError: see `require`, or the checkpoint is another model's.
        """
        self.require(fill)
        module, _, function = self.load.partition(":")
        loader: Callable[[Fill, Adapter], Any] = getattr(importlib.import_module(module), function)
        return loader(fill, self)


def _found(path: Path, name: str) -> list[Path]:
    """Files of a checkpoint's folder that a name or pattern stands for; alternatives are parted by `|`."""
    folder = path if path.is_dir() else path.parent
    return [found for alternative in name.split("|") for found in folder.glob(alternative)]
