"""Where networks come from: an archive of a package registry, fetched as a file; nothing of it is installed or run."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tarfile
import time
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

POLL_S = 0.1  # how often the growing download is measured for the progress bar
STDERR_TAIL = 600  # characters of the complaint worth repeating


class ModelFileError(ValueError):
    """A model file or the archive it comes from is not what the manifest says, or could not be fetched."""


PullProgress = Callable[[int, int, str], None]
"""Called during a pull with bytes done, bytes in total, and a word on what is going on."""


@dataclass(frozen=True)
class Archive(ABC):
    """A package's archive that carries model files.

    Attributes:
        package: its name in the registry.
        version: pinned.
        file: the archive's name.
        sha256: of the archive.
        size: bytes.
        program: what fetches it.
    """

    program: ClassVar[str]
    package: str
    version: str
    file: str
    sha256: str
    size: int

    @property
    def label(self) -> str:
        """Package and version."""
        return f"{self.package} {self.version}"

    @abstractmethod
    def read(self, archive: Path, member: str) -> bytes:
        """One file of the archive.

        Raises:
            KeyError: it is not in there.
        """

    @abstractmethod
    def command(self, folder: Path, options: Sequence[str]) -> list[str]:
        """What puts the archive into a folder.

        Raises:
            ModelFileError: the program for it is not on this machine.
        """


@dataclass(frozen=True)
class Wheel(Archive):
    """A Python wheel; the last four fields pick the same file whatever machine asks."""

    program = "pip"
    python_version: str
    implementation: str
    abi: str
    platform: str

    def read(self, archive: Path, member: str) -> bytes:
        """See `Archive`."""
        with zipfile.ZipFile(archive) as wheel:
            return wheel.read(member)

    def command(self, folder: Path, options: Sequence[str]) -> list[str]:
        """See `Archive`; `options` go on to pip."""
        words = [sys.executable, "-m", "pip", "download", f"{self.package}=={self.version}", "--no-deps", "--dest"]
        words += [str(folder), "--only-binary=:all:", "--python-version", self.python_version, "--abi", self.abi]
        words += ["--implementation", self.implementation, "--platform", self.platform]
        return [*words, "--quiet", "--disable-pip-version-check", *options]


@dataclass(frozen=True)
class NpmTarball(Archive):
    """A tarball of the JavaScript registry, where a network's other sizes are; npm fetches it and runs no script."""

    program = "npm"

    def read(self, archive: Path, member: str) -> bytes:
        """See `Archive`."""
        with tarfile.open(archive) as tarball:
            file = tarball.extractfile(member)
            if file is None:
                raise KeyError(member)
            return file.read()

    def command(self, folder: Path, options: Sequence[str]) -> list[str]:
        """See `Archive`; `options` are pip's and not used."""
        npm = shutil.which("npm")
        if npm is None:
            raise ModelFileError(
                f"expected npm on this machine to fetch {self.label}, got none; install it, or pull elsewhere and copy "
                "the file (`ahoy models list` says where files are kept)"
            )
        words = [npm, "pack", f"{self.package}@{self.version}", "--pack-destination", str(folder)]
        return [*words, "--ignore-scripts", "--silent", "--cache", str(folder / "npm")]


def fetch(archive: Archive, scratch: Path, report: PullProgress, options: Sequence[str]) -> Path:
    """Put the archive into `scratch`; its program's temporary files go there too, to be measured and to vanish with it.

    Args:
        archive: which.
        scratch: an empty folder.
        report: called with bytes fetched so far.
        options: see `Archive.command`.

    Raises:
        ModelFileError: the program failed, or is not here.
    """
    command = archive.command(scratch, options)
    environment = {**os.environ, "TMPDIR": str(scratch), "TEMP": str(scratch), "TMP": str(scratch)}
    with (scratch / "log").open("w+b") as log:
        process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            while process.poll() is None:
                report(min(_bytes_below(scratch), archive.size), archive.size, archive.label)
                time.sleep(POLL_S)
        finally:
            process.kill()
            process.wait()
        log.seek(0)
        complaint = log.read().decode(errors="replace").strip()[-STDERR_TAIL:]
    found = scratch / archive.file
    if process.returncode != 0 or not found.is_file():
        got = ", ".join(sorted(path.name for path in scratch.glob("*" + found.suffix))) or f"no {found.suffix[1:]}"
        raise ModelFileError(
            f"expected {archive.program} to fetch {archive.file}, got {got} (exit {process.returncode}): {complaint}; "
            f"check the connection and {archive.program}'s registry settings, then run `ahoy models pull` again"
        )
    return found


def _bytes_below(folder: Path) -> int:
    """Sum the sizes of all files. pip deletes files and folders meanwhile: `os.walk` bears that, `rglob` does not."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += (Path(parent) / name).stat().st_size
    return total
