"""Videos in object stores: a real S3 server, fsspec's in-memory file system, and one that breaks."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from tasks.errors import MissingExtraError, MissingSourceError, RefusedSourceError, UnusableSourceError
from tasks.sources import SourcePolicy, fetch_source
from tests.storage.s3 import s3_bucket, s3_server


@pytest.fixture(scope="module")
def s3() -> Iterator[int]:
    pytest.importorskip("s3fs", reason="needs the extra ahoy[s3]")
    pytest.importorskip("moto", reason="needs moto[server]")
    with s3_server() as port:
        yield port


@pytest.fixture(params=["memory", "s3"])
def bucket(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "s3":
        with s3_bucket(request.getfixturevalue("s3")) as name:
            yield f"s3://{name}"
        return
    url = f"memory://{uuid.uuid4().hex}"
    yield url
    fs = fsspec.filesystem("memory")
    if fs.exists(url):
        fs.rm(url, recursive=True)


@pytest.fixture
def policy() -> SourcePolicy:
    return SourcePolicy(object_protocols=("memory", "s3", "flaky", "gs"), attempts=4, backoff_s=0.001)


def put(url: str, data: bytes) -> str:
    with fsspec.open(url, "wb") as file:
        file.write(data)
    return url


def test_an_object_comes_whole_and_a_changed_one_anew(
    bucket: str, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = put(f"{bucket}/clips/walk.mp4", clip)
    source = fetch_source(url, policy, cache)
    assert source.path.read_bytes() == clip and source.name == "walk"
    assert fetch_source(put(url, clip + b"x"), policy, cache).path.read_bytes() == clip + b"x"


def test_an_object_that_is_not_there_or_is_a_folder_is_bad_input(
    bucket: str, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    put(f"{bucket}/folder/a.mp4", clip)
    with pytest.raises(MissingSourceError, match="nothing there"):
        fetch_source(f"{bucket}/none.mp4", policy, cache)
    with pytest.raises(UnusableSourceError, match="folder"):
        fetch_source(f"{bucket}/folder", policy, cache)


def test_an_object_is_held_to_the_same_limits_as_a_download(
    bucket: str, clip: bytes, policy: SourcePolicy, cache: Path
) -> None:
    url = put(f"{bucket}/a.mp4", clip)
    with pytest.raises(RefusedSourceError, match="MAX_BYTES"):
        fetch_source(url, policy.model_copy(update={"max_bytes": 10}), cache)
    with pytest.raises(UnusableSourceError, match="names other files"):
        fetch_source(put(f"{bucket}/b.mp4", b"#EXTM3U\n/etc/passwd\n"), policy, cache)


class Flaky(MemoryFileSystem):
    """Breaks off after `step` bytes, every time; counts what was read."""

    protocol = "flaky"
    step = 5000
    read_bytes: list[int] = []  # noqa: RUF012 - reset by the test

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return super()._strip_protocol(path.replace("flaky://", "memory://"))

    def _open(self, path, mode="rb", **kwargs):  # type: ignore[no-untyped-def]
        file = super()._open(path, mode, **kwargs)
        if mode == "rb":
            whole = file.read
            left = [self.step]

            def read(size: int = -1) -> bytes:
                if not left[0]:
                    raise ConnectionResetError("reset")
                data = whole(min(size, left[0]) if size > 0 else left[0])
                left[0] -= len(data)
                self.read_bytes.append(len(data))
                return data

            file = _Reader(file, read)
        return file


class _Reader:
    def __init__(self, file, read) -> None:  # type: ignore[no-untyped-def]
        self._file, self.read = file, read

    def seek(self, place: int) -> None:
        self._file.seek(place)

    def __enter__(self) -> _Reader:
        return self

    def __exit__(self, *_: object) -> None:
        return None


def test_a_broken_read_goes_on_where_it_stopped(clip: bytes, policy: SourcePolicy, cache: Path) -> None:
    fsspec.register_implementation("flaky", Flaky, clobber=True)
    data = (clip * 4)[:14_000]
    with fsspec.open("memory://box/a.mp4", "wb") as file:
        file.write(data)
    Flaky.read_bytes.clear()
    assert fetch_source("flaky://box/a.mp4", policy, cache).path.read_bytes() == data
    assert sum(Flaky.read_bytes) == len(data)


def test_a_missing_package_is_named(policy: SourcePolicy, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "gcsfs", None)
    with pytest.raises(MissingExtraError, match="install"):
        fetch_source("gs://bucket/a.mp4", policy, cache)
