"""A stage can publish only what it declares."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from storage_schema.artifacts import ARTIFACTS, Array, Blob
from storage_schema.check import check
from storage_schema.errors import ArtifactError

DECLARED = {
    "toy": (
        Blob("a.npz", {"x": Array("float32", ("T", 3)), "used": Array("bool", ("T",))}),
        Blob("b.npz", {"y": Array("uint8", ("T", "H"))}),
        Blob("note.json"),
        Blob("film.mp4", optional=True),
    )
}


def write(folder: Path) -> None:
    np.savez(folder / "a.npz", x=np.zeros((4, 3), np.float32), used=np.ones(4, bool))
    np.savez_compressed(folder / "b.npz", y=np.zeros((4, 7), np.uint8))
    (folder / "note.json").write_text('{"a": [1, null]}')


def test_what_is_declared_passes_with_and_without_optional_files(tmp_path: Path) -> None:
    write(tmp_path)
    assert check("toy", tmp_path, DECLARED) == ("a.npz", "b.npz", "note.json")
    (tmp_path / "film.mp4").write_bytes(b"film")
    assert "film.mp4" in check("toy", tmp_path, DECLARED)


class Bomb:
    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, ("exploded",)


def _a(**arrays: np.ndarray) -> Callable[[Path], None]:
    good = {"x": np.zeros((4, 3), np.float32), "used": np.ones(4, bool)}
    merged = {**good, **arrays}
    return lambda folder: np.savez(folder / "a.npz", **{k: v for k, v in merged.items() if v is not None})


def _truncate(folder: Path) -> None:
    data = (folder / "a.npz").read_bytes()
    (folder / "a.npz").write_bytes(data[: len(data) // 2])


def _short_member(folder: Path) -> None:
    with zipfile.ZipFile(folder / "b.npz") as archive:
        data = archive.read("y.npy")
    with zipfile.ZipFile(folder / "b.npz", "w") as archive:
        archive.writestr("y.npy", data[:-1])


def _pickle_member(folder: Path) -> None:
    with zipfile.ZipFile(folder / "b.npz", "w") as archive:
        archive.writestr("y.npy", pickle.dumps(Bomb()))


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing file": (lambda f: (f / "b.npz").unlink(), r"\['b.npz'\] are missing"),
    "undeclared file": (lambda f: (f / "c.txt").write_text("c"), r"undeclared files \['c.txt'\]"),
    "undeclared file in a folder": (lambda f: ((f / "d").mkdir(), (f / "d" / "c").write_text("c")), r"\['d/c'\]"),
    "hidden file": (lambda f: (f / ".c").write_text("c"), "file name '.c'"),
    "odd name": (lambda f: (f / "a b").write_text("c"), "file name 'a b'"),
    "link": (lambda f: (f / "film.mp4").symlink_to(f / "note.json"), "film.mp4: expected a plain file"),
    "pipe": (lambda f: os.mkfifo(f / "film.mp4"), "film.mp4: expected a plain file"),
    "empty file": (lambda f: (f / "film.mp4").touch(), "film.mp4 is empty"),
    "missing array": (_a(used=None), r"missing \['used'\]"),
    "undeclared array": (_a(z=np.zeros(1)), r"undeclared \['z'\]"),
    "dtype": (_a(x=np.zeros((4, 3), np.float64)), "a.npz:x: expected dtype float32, got float64"),
    "byte order": (_a(x=np.zeros((4, 3), ">f4")), "a.npz:x: expected dtype float32, got >f4"),
    "number of dimensions": (_a(x=np.zeros((4, 3, 1), np.float32)), r"expected shape \[T, 3\], got \[4, 3, 1\]"),
    "fixed size": (_a(x=np.zeros((4, 2), np.float32)), r"expected shape \[T, 3\], got \[4, 2\]"),
    "letter within a file": (_a(used=np.ones(5, bool)), r"a.npz:used: expected shape \[T\] with T = 4 as in a.npz:x"),
    "letter across files": (
        _a(x=np.zeros((5, 3), np.float32), used=np.ones(5, bool)),
        r"b.npz:y: expected shape \[T, H\] with T = 5 as in a.npz",
    ),
    "objects": (_a(x=np.array([Bomb()], object)), "Python objects"),
    "pickle in place of an array": (_pickle_member, "b.npz: expected arrays"),
    "truncated": (_truncate, "a.npz: expected arrays"),
    "array shorter than its header": (_short_member, "its header promises"),
    "not a zip": (lambda f: (f / "a.npz").write_bytes(b"hello"), "a.npz: expected arrays"),
    "not json": (lambda f: (f / "note.json").write_text("{"), "note.json: expected strict JSON"),
    "NaN in json": (lambda f: (f / "note.json").write_text('{"a": NaN}'), "NaN is not JSON"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_not_as_declared_is_refused_by_name(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "artifact"
    folder.mkdir()
    write(folder)
    spoil, message = WRONG[name]
    spoil(folder)
    with pytest.raises(ArtifactError, match=message):
        check("toy", folder, DECLARED)
    assert not (tmp_path / "exploded").exists(), "something was unpickled"


def test_a_stage_that_declares_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="'nothing' declares no files"):
        check("nothing", tmp_path)


def test_the_declarations_of_the_real_stages_can_be_stored() -> None:
    for stage, blobs in ARTIFACTS.items():
        assert len({blob.name for blob in blobs}) == len(blobs), stage
        for blob in blobs:
            assert bool(blob.arrays) == blob.name.endswith(".npz"), f"{stage}/{blob.name}"
            for array in blob.arrays.values():
                assert not np.dtype(array.dtype).hasobject
