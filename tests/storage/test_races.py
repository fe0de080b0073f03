"""Several processes at one store: one commit wins, one lease is held, no row is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from storage_schema.lease import Lease
from storage_schema.manifest import Manifest
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

from .toy import ARTIFACTS, KEY, commit, load, open_store

WORKERS, KEYS = 3, 24
# Each worker commits its own number under every key, all of them starting on a key at the same time.
WORKER = """
import json, sys, time
from pathlib import Path
from storage.toy import commit, load, open_store
root, me, workers, keys = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), json.loads(sys.argv[4])
store = open_store(root / "store")
won = {}
for key in keys:
    (root / f"{key}-{me}").touch()
    while not all((root / f"{key}-{other}").exists() for other in range(workers)):
        pass
    manifest = commit(store, float(me), key)
    won[key] = [manifest.attempt, load(store, manifest)]
print(json.dumps(won))
"""


def run_workers(root: Path, keys: list[str]) -> list[dict[str, tuple[str, float]]]:
    paths = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    arguments = [
        [sys.executable, "-c", WORKER, str(root), str(me), str(WORKERS), json.dumps(keys)] for me in range(WORKERS)
    ]
    workers = [subprocess.Popen(argument, env=environment, stdout=subprocess.PIPE, text=True) for argument in arguments]
    outputs = [worker.communicate()[0] for worker in workers]
    assert [worker.returncode for worker in workers] == [0] * WORKERS
    return [json.loads(output) for output in outputs]


def test_of_several_processes_that_commit_a_key_exactly_one_wins_and_all_get_its_result(tmp_path: Path) -> None:
    store = open_store(tmp_path / "store")
    keys = [f"{number:064d}" for number in range(KEYS)]
    for key in keys[::2]:
        # Half of the races are for the repair of a damaged artifact.
        store.backend.remove(commit(store, -1.0, key).blob("points.npz").path)
    results = run_workers(tmp_path, keys)
    winners = set()
    for number, key in enumerate(keys):
        manifest = store.lookup(key)
        assert manifest is not None
        assert {(result[key][0], result[key][1]) for result in results} == {(manifest.attempt, load(store, manifest))}
        names = store.backend.names(f"artifacts/toy/{key}")
        assert len([name for name in names if name.startswith("manifest")]) == (2 if number % 2 == 0 else 1)
        assert len(store.backend.names(f"artifacts/toy/{key}/attempts")) == (2 if number % 2 == 0 else 1)
        winners.add(load(store, manifest))
    assert winners <= set(map(float, range(WORKERS)))


@pytest.mark.parametrize("repair", [False, True])
def test_a_commit_that_falls_between_anothers_look_and_its_write_wins(
    store: ArtifactStore, tmp_path: Path, repair: bool
) -> None:
    class Overtaken(ArtifactStore):
        rival: Manifest | None = None

        def _newest_whole(self, stage: str, key: str, generations: list[int], verify: bool) -> Manifest | None:
            found = super()._newest_whole(stage, key, generations, verify)
            if self.rival is None:
                self.rival = commit(store, 2.0)
            return found

    if repair:
        store.backend.remove(commit(store, 0.0).blob("note.json").path)
    overtaken = Overtaken(store.url, cache_dir=tmp_path / "other", artifacts=ARTIFACTS)
    assert commit(overtaken, 1.0) == overtaken.rival == store.lookup(KEY)


def test_one_of_many_threads_wins_in_memory_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = MemoryFileSystem.exists

    def slow(*args: Any, **kwargs: Any) -> bool:
        found = real(*args, **kwargs)
        time.sleep(
            0.01
        )  # what the file system does between its look and its write: give the others the time to do the same
        return found

    monkeypatch.setattr(MemoryFileSystem, "exists", slow)
    store = open_store(f"memory://{tmp_path.name}", tmp_path)
    barrier, attempts = threading.Barrier(8), []

    def work(value: float) -> None:
        barrier.wait()
        attempts.append(commit(store, value).attempt)

    threads = [threading.Thread(target=work, args=(float(n),)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(attempts) == 8 and len(set(attempts)) == 1


def test_a_lease_is_held_by_one_at_a_time_and_free_again_afterwards(store: ArtifactStore) -> None:
    for _ in range(3):
        with store.lease(KEY, "first", 60) as first, store.lease(KEY, "second", 60) as second:
            assert first and not second
            holder = second.holder()
            assert holder is not None and holder.owner == "first"
            with store.lease("0" * 64, "second", 60) as other:
                assert other
    assert store.backend.files("leases") == []


def test_a_lease_is_given_back_when_its_block_fails(store: ArtifactStore) -> None:
    with pytest.raises(RuntimeError), store.lease(KEY, "first", 60):
        raise RuntimeError
    with store.lease(KEY, "second", 60) as second:
        assert second


def abandoned(store: ArtifactStore, ttl_s: float) -> Lease:
    """What a killed worker leaves: a lease that nobody renews."""
    lease = store.lease(KEY, "killed", ttl_s)
    assert lease._take()
    return lease


def test_an_expired_lease_is_taken_over_by_exactly_one(store: ArtifactStore) -> None:
    abandoned(store, 0.05)
    time.sleep(0.06)
    barrier, held = threading.Barrier(6), []

    def work(name: str) -> None:
        lease = store.lease(KEY, name, 60)
        barrier.wait()
        held.append(lease._take())

    threads = [threading.Thread(target=work, args=(f"w{n}",)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(held) == [False] * 5 + [True]
    assert len(store.backend.files("leases")) == 1, "the expired one is cleared away"


def test_a_worker_can_wait_for_a_lease(store: ArtifactStore) -> None:
    abandoned(store, 2.0)
    with store.lease(KEY, "impatient", 60) as held:
        assert not held
    with store.lease(KEY, "patient", 60, wait_s=30) as held:
        assert held


def test_a_lease_outlives_its_time_while_its_holder_works(store: ArtifactStore) -> None:
    with store.lease(KEY, "slow", 0.6) as slow:
        time.sleep(1.2)
        with store.lease(KEY, "other", 60) as other:
            assert slow and not other


def test_a_lease_that_was_taken_over_is_not_given_back_by_its_former_holder(store: ArtifactStore) -> None:
    former = abandoned(store, 0.05)
    time.sleep(0.06)
    with store.lease(KEY, "new", 60) as new:
        assert new and not former._take()
        former._release()
        with store.lease(KEY, "third", 60) as third:
            assert not third


def test_a_damaged_lease_stops_nobody(store: ArtifactStore) -> None:
    store.backend.write(f"leases/{KEY}/0001.json", b"{")
    with store.lease(KEY, "me", 60) as held:
        assert held


def foreign(store: ArtifactStore, ahead_s: float, ttl_s: float, number: int = 1) -> None:
    """The lease of another machine, whose clock is ahead by so much."""
    expires_at = time.time() + ahead_s + ttl_s
    holder = {"owner": "far", "token": "t", "expires_at": expires_at, "ttl_s": ttl_s, "host": "another-machine"}
    store.backend.write(f"leases/{KEY}/{number:04d}.json", json.dumps(holder).encode())


def test_a_dead_holder_whose_clock_was_ahead_is_found_out_by_watching(store: ArtifactStore) -> None:
    foreign(store, ahead_s=86_400, ttl_s=0.2)
    with store.lease(KEY, "impatient", 60) as held:
        assert not held
    with store.lease(KEY, "patient", 60, wait_s=30) as held:
        assert held


def test_a_live_holder_whose_clock_is_behind_keeps_its_lease(store: ArtifactStore) -> None:
    stop = threading.Event()

    def renew() -> None:
        number = 1
        while not stop.is_set():
            foreign(store, ahead_s=-120, ttl_s=5.0, number=number)
            stop.wait(0.1)
            number += 1
            store.backend.remove(f"leases/{KEY}/{number - 2:04d}.json")

    holder = threading.Thread(target=renew)
    foreign(store, ahead_s=-120, ttl_s=5.0)
    holder.start()
    try:
        with store.lease(KEY, "me", 60, wait_s=0.6) as held:
            assert not held, "by its dates it was over two minutes ago"
    finally:
        stop.set()
        holder.join()


def test_a_lease_that_no_clock_error_explains_is_over_at_once(store: ArtifactStore) -> None:
    foreign(store, ahead_s=-3600, ttl_s=60.0)
    with store.lease(KEY, "me", 60) as held:
        assert held


@pytest.mark.parametrize(("ttl", "wait"), [(0, 0), (-1, 0), (float("nan"), 0), (1, -1)])
def test_bad_times_of_a_lease_are_refused(store: ArtifactStore, ttl: float, wait: float) -> None:
    with pytest.raises(ValueError, match="ttl_s > 0"):
        store.lease(KEY, "me", ttl, wait_s=wait)


def test_rows_appended_and_read_while_others_compact_are_all_there_once(store: ArtifactStore) -> None:
    tables = Tables(store)
    row = {"video_id": "v", "key": "k", "index": 0, "pts": 0.0, "used": True, "confidence": 1.0}
    writers, each, errors, done = 2, 12, [], threading.Event()

    def append(writer: int) -> None:
        for n in range(each):
            tables.append("frames", [{**row, "frame": writer * each + n}], batch="b")

    def until_done(work: object) -> None:
        try:
            while not done.is_set():
                work()  # type: ignore[operator]
        except Exception as error:
            errors.append(error)

    def read() -> None:
        frames = tables.read("frames", "b")["frame"].to_pylist()
        assert len(frames) == len(set(frames))
        for writer in range(writers):
            mine = sorted(frame for frame in frames if frame // each == writer)
            assert mine == list(range(writer * each, writer * each + len(mine))), "a row that was there is missing"

    others = [
        threading.Thread(target=until_done, args=(work,)) for work in (read, lambda: tables.compact("frames", "b"))
    ]
    others.append(threading.Thread(target=until_done, args=(lambda: tables.compact("frames", "b"),)))
    appenders = [threading.Thread(target=append, args=(writer,)) for writer in range(writers)]
    for thread in [*others, *appenders]:
        thread.start()
    for thread in appenders:
        thread.join()
    done.set()
    for thread in others:
        thread.join()
    assert errors == []
    assert sorted(tables.read("frames", "b")["frame"].to_pylist()) == list(range(writers * each))
