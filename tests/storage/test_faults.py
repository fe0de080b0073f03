"""Power cuts, full disks and dying connections leave no manifest or a whole artifact."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fsspec import register_implementation
from fsspec.implementations.memory import MemoryFileSystem

from storage_schema.batches import BatchEntry, BatchManifest, list_batches, read_batch, submit
from storage_schema.errors import StoreFullError, StoreUnavailableError, is_full
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

from .toy import KEY, commit, load, open_store, publish, write, written

KILLED, DONE, FAILED = 41, 0, 42
CHANGES = {"os.mkdir", "os.rename", "os.link", "os.remove", "os.rmdir"}
ROW = {"video_id": "v", "key": "k", "frame": 0, "index": 0, "pts": 0.0, "used": True, "confidence": 1.0}


def in_child(work: Callable[[], object], kill_before: int | None = None) -> int:
    """Run `work` in a process of its own, killed just before it changes the file system for the nth time (from 0)."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    left = kill_before

    def hook(event: str, args: tuple[Any, ...]) -> None:
        nonlocal left
        writes = event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if left is not None and (event in CHANGES or writes):
            if left == 0:
                os._exit(KILLED)
            left -= 1

    try:
        sys.addaudithook(hook)
        work()
    except BaseException as error:
        os.write(2, f"{error!r}\n".encode())
        os._exit(FAILED)
    os._exit(DONE)


def test_a_kill_between_any_two_steps_of_a_commit_leaves_nothing_or_everything(tmp_path: Path) -> None:
    results = []
    for step in range(100):
        root = tmp_path / str(step)
        code = in_child(lambda: commit(open_store(root), 1.0), step)  # noqa: B023
        store = open_store(root)
        found = store.lookup(KEY)
        results.append((code, found is not None))
        if found is not None:
            assert load(store, found) == 1.0
        assert store.lookup(commit(store, 1.0).key) is not None, "the rerun has to succeed"
        store.gc(older_than_s=-1)
        assert len(store.backend.files("")) == 3, "the orphan and its scratch are collected"
        if code == DONE:
            break
    codes = [code for code, _ in results]
    assert codes == [KILLED] * (len(codes) - 1) + [DONE] and len(codes) > 10
    assert {whole for _, whole in results} == {True, False}


def test_a_kill_between_any_two_steps_of_a_repair_leaves_a_store_that_can_be_repaired(tmp_path: Path) -> None:
    for step in range(100):
        root = tmp_path / str(step)
        store = open_store(root)
        store.backend.remove(commit(store, 1.0).blob("note.json").path)
        code = in_child(lambda: commit(open_store(root), 2.0), step)  # noqa: B023
        found = store.lookup(KEY)
        assert load(store, found or commit(store, 2.0)) == 2.0
        if code == DONE:
            assert step >= 8
            return
    pytest.fail("the repair never finished")


def test_a_kill_between_any_two_steps_of_an_append_or_a_compaction_loses_and_doubles_no_row(tmp_path: Path) -> None:
    def add_and_compact(root: Path) -> None:
        tables = Tables(open_store(root))
        tables.append("frames", [{**ROW, "frame": 3}, {**ROW, "frame": 4}], batch="b")
        tables.compact("frames", "b")

    for step in range(100):
        root = tmp_path / str(step)
        tables = Tables(open_store(root))
        for frame in range(3):
            tables.append("frames", [{**ROW, "frame": frame}], batch="b")
        code = in_child(lambda: add_and_compact(root), step)  # noqa: B023
        frames = tables.read("frames", "b")["frame"].to_pylist()
        assert frames in ([0, 1, 2], [0, 1, 2, 3, 4])
        tables.compact("frames", "b")
        assert tables.read("frames", "b")["frame"].to_pylist() == frames
        assert len(tables._partition("frames", "b").snapshot().parts) == 1
        if code == DONE:
            assert step >= 8
            return
    pytest.fail("the compaction never finished")


def test_a_kill_between_any_two_steps_of_a_submit_leaves_no_batch_or_all_of_it(tmp_path: Path) -> None:
    batch = BatchManifest.of("b", [BatchEntry(f"v{i}", f"v{i}.mp4") for i in range(5)])
    for step in range(100):
        store = open_store(tmp_path / str(step))
        code = in_child(lambda: submit(store, batch), step)  # noqa: B023
        submit(store, batch)
        assert read_batch(store, "b") == batch and list_batches(store) == ["b"]
        if code == DONE:
            assert step >= 4
            return
    pytest.fail("the submit never finished")


def test_everything_is_flushed_to_the_disk_before_the_manifest_appears(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: set[int] = set()
    missing: list[str] = []
    real_fsync, real_link = os.fsync, os.link

    def fsync(descriptor: int) -> None:
        real_fsync(descriptor)
        flushed.add(os.fstat(descriptor).st_ino)

    def link(source: Path, target: Path) -> None:
        root = tmp_path / "store"
        needed = [source, *(root / "artifacts").rglob("*")]
        missing.extend(str(path) for path in [*needed, root, tmp_path] if path.stat().st_ino not in flushed)
        real_link(source, target)
        flushed.discard(Path(target).parent.stat().st_ino)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "link", link)
    manifest = commit(open_store(tmp_path / "store"))
    assert missing == []
    assert (tmp_path / "store" / "artifacts" / "toy" / manifest.key).stat().st_ino in flushed


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP])
def test_a_disk_without_hard_links_still_lets_one_commit_win(
    disk_store: ArtifactStore, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def link(source: object, target: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", link)
    assert disk_store.backend.create("x", b"first") and not disk_store.backend.create("x", b"second")
    assert disk_store.backend.read("x") == b"first"
    with written(disk_store, 1.0) as one, written(disk_store, 2.0) as other:
        winner = publish(one)
        assert publish(other) == winner == disk_store.lookup(KEY)


class Failing(MemoryFileSystem):
    """fsspec's memory, whose nth change fails (and all after it, if the connection is gone for good)."""

    protocol = "failing"
    store: dict[str, Any] = {}  # noqa: RUF012 -- shared by all instances, as in the class above it
    pseudo_dirs = [""]  # noqa: RUF012
    left: int | None = None
    for_good = False

    def _step(self) -> None:
        if Failing.left is None:
            return
        if Failing.left == 0 or (Failing.left < 0 and Failing.for_good):
            Failing.left -= 1
            raise ConnectionError("the connection broke")
        Failing.left -= 1

    def _open(self, path: str, mode: str = "rb", **kwargs: Any) -> Any:
        if mode != "rb":
            self._step()
        return super()._open(path, mode=mode, **kwargs)

    def makedirs(self, path: str, exist_ok: bool = False) -> None:
        self._step()
        super().makedirs(path, exist_ok=exist_ok)

    def rm(self, path: str, recursive: bool = False, maxdepth: int | None = None) -> None:
        self._step()
        super().rm(path, recursive=recursive, maxdepth=maxdepth)


register_implementation("failing", Failing, clobber=True)


@pytest.mark.parametrize("for_good", [False, True])
def test_a_connection_that_breaks_at_any_step_leaves_nothing_or_everything(tmp_path: Path, for_good: bool) -> None:
    Failing.for_good = for_good
    for step in range(100):
        store = open_store(f"failing://{uuid.uuid4().hex}", tmp_path / "cache")
        store.backend.create("warm", b"")  # the test for create-if-absent, done once for each store, is not part of it
        Failing.left = step
        try:
            commit(store, 1.0)
            broke = Failing.left < 0
        except StoreUnavailableError:
            broke = True
        finally:
            Failing.left = None
        found = store.lookup(KEY)
        assert load(store, found or commit(store, 1.0)) == 1.0
        assert not list((tmp_path / "cache" / "scratch").iterdir())
        if not broke:
            assert step > 5
            return
    pytest.fail("the commit never finished")


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = shutil.which("mount")
    if mount is None or subprocess.run([mount, "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk], check=False).returncode:
        pytest.skip("needs the right to mount a tmpfs")
    yield disk
    subprocess.run(["umount", disk], check=True)


def fill(disk: Path) -> Path:
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(b"\0" * 4096)
        except OSError as error:
            assert error.errno == errno.ENOSPC
    return filler


def test_a_disk_that_fills_up_while_a_stage_writes_is_named_and_leaves_nothing(tiny_disk: Path) -> None:
    store = open_store(tiny_disk / "store")
    message = r"no room left for .*free some space and run again"
    with pytest.raises(StoreFullError, match=message) as caught, store.attempt(KEY, "toy") as attempt:
        np.savez(attempt.dir / "points.npz", x=np.ones((200_000, 3), np.float32))
    assert caught.value.filename == str(attempt.dir)
    assert caught.value.needed > 1_000_000 and caught.value.errno == errno.ENOSPC
    assert store.lookup(KEY) is None and store.backend.files("") == []
    assert load(store, commit(store, 1.0)) == 1.0, "the space is free again"


@pytest.mark.parametrize("when", ["before the commit", "before the manifest"])
def test_a_disk_that_is_full_at_the_commit_publishes_nothing(
    tiny_disk: Path, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_store(tiny_disk / "store")
    with pytest.raises(StoreFullError) as caught, written(store) as attempt:
        if when == "before the commit":
            filler = fill(tiny_disk)
        else:
            real = store.publish
            filler = tiny_disk / "filler"
            monkeypatch.setattr(store, "publish", lambda manifest: (fill(tiny_disk), real(manifest))[1])
        publish(attempt)
    assert str(caught.value.filename).startswith(str(tiny_disk)) and caught.value.needed > 0
    filler.unlink()
    monkeypatch.undo()
    assert store.lookup(KEY) is None and store.backend.files("") == []
    assert store.lookup(commit(store).key) is not None


def test_a_table_on_a_full_disk_stays_as_it_was(tiny_disk: Path) -> None:
    tables = Tables(open_store(tiny_disk / "store"))
    tables.append("frames", [ROW], batch="b")
    before = tables._backend.files("")
    filler = fill(tiny_disk)
    with pytest.raises(StoreFullError, match=r"frames/batch=b/.*\.parquet"):
        tables.append("frames", [{**ROW, "frame": 1}], batch="b")
    assert tables._backend.files("") == before
    filler.unlink()
    assert tables.read("frames").num_rows == 1


def test_a_limit_on_file_size_counts_as_a_full_disk(tmp_path: Path) -> None:
    def work() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
        store = open_store(tmp_path / "store")
        try:
            with store.attempt(KEY, "toy") as attempt:
                write(attempt.dir)
                (attempt.dir / "extra.bin").write_bytes(b"x" * 20_000)
        except StoreFullError:
            assert store.backend.files("") == []
            return
        raise AssertionError("20 kB were written under a limit of 10 kB")

    assert in_child(work) == DONE


def test_full_disks_are_recognised_by_number_and_in_the_words_of_other_writers() -> None:
    chained = RuntimeError("cannot save")
    chained.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    assert is_full(chained)
    assert is_full(RuntimeError("Error while serializing: I/O error: No space left on device (os error 28)"))
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        assert is_full(OSError(number, "in another language"))
    assert not is_full(RuntimeError("cannot save")) and not is_full(OSError(errno.EACCES, "Permission denied"))
