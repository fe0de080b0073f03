"""The store on S3: the promises of the store on a disk, kept over a network that breaks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

from storage_schema.batches import BatchEntry, BatchManifest, read_batch, submit
from storage_schema.errors import CorruptError, StoreError, StoreFullError, StoreUnavailableError
from storage_schema.store import ArtifactStore
from storage_schema.tables import Tables

from .s3 import CHANGES, CREDENTIALS, Proxy, proxy_before, s3_bucket, s3_server, use
from .toy import ARTIFACTS, KEY, commit, load, open_store, publish, written

s3fs = pytest.importorskip("s3fs", reason="needs the extra ahoy[s3]")
pytest.importorskip("moto", reason="needs moto[server]")

ROW = {"video_id": "v", "key": "k", "frame": 0, "index": 0, "pts": 0.0, "used": True, "confidence": 1.0}


@pytest.fixture(scope="module")
def server() -> Iterator[int]:
    with s3_server() as port:
        yield port


@pytest.fixture
def bucket(server: int) -> Iterator[str]:
    """Name of an empty bucket; `s3://` leads to the server."""
    with s3_bucket(server) as name:
        yield name


@pytest.fixture
def url(bucket: str) -> str:
    return f"s3://{bucket}/store"


@pytest.fixture
def proxy(server: int, bucket: str) -> Iterator[Proxy]:
    """`s3://` leads through it from now on."""
    with proxy_before(server) as proxy:
        s3fs.S3FileSystem.clear_instance_cache()
        use(proxy.url)
        yield proxy
        proxy.plan = lambda method, path: "pass"


def open_s3(url: str, tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(url, cache_dir=tmp_path / "cache", workers=2, artifacts=ARTIFACTS)


def objects(store: ArtifactStore) -> list[str]:
    return store.backend.files("")


def test_a_store_on_s3_takes_several_workers_and_keeps_what_they_commit(url: str, tmp_path: Path) -> None:
    store = open_s3(url, tmp_path)
    assert store.lookup(KEY) is None and objects(store) == [], "the probe for create-if-absent is gone"
    with written(store, 1.0) as fast, written(store, 2.0) as slow:
        winner = publish(fast)
        assert publish(slow) == winner
    again = open_s3(url, tmp_path / "elsewhere")
    found = again.lookup(KEY)
    assert found == winner and load(again, found) == 1.0
    assert {path for path in objects(store) if "manifest" not in path} == {blob.path for blob in winner.blobs}


@pytest.mark.parametrize("damage", ["deleted", "truncated", "changed"])
def test_a_damaged_artifact_is_not_found_and_repaired_and_collected(url: str, tmp_path: Path, damage: str) -> None:
    store = open_s3(url, tmp_path)
    path = commit(store, 1.0).blob("points.npz").path
    data = store.backend.read(path)
    store.backend.remove(path)
    if damage != "deleted":
        store.backend.write(path, data[:-1] if damage == "truncated" else data[:-1] + bytes([data[-1] ^ 1]))
    assert store.lookup(KEY) is None
    second = commit(store, 2.0)
    found = store.lookup(KEY)
    assert found == second and load(store, second) == 2.0
    store.backend.write(f"artifacts/toy/{KEY}/attempts/killed/points.npz", b"half")
    assert store.gc(3600) == [] and len(store.gc(-1)) == 2
    assert len(objects(store)) == 4 and store.lookup(KEY) == second  # two manifests, two blobs


WORKER = """
import json, sys, time
from pathlib import Path
from storage.toy import ARTIFACTS, commit, load
from storage_schema.batches import BatchEntry, BatchManifest, submit
from storage_schema.store import ArtifactStore
url, root, me, workers, rounds = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5])
store = ArtifactStore(url, cache_dir=root / f"cache{me}", workers=workers, artifacts=ARTIFACTS)
def meet(name):
    (root / f"{name}-{me}").touch()
    while not all((root / f"{name}-{other}").exists() for other in range(workers)):
        time.sleep(0.001)
created, won, new = [], [], []
for n in range(rounds):
    meet(f"create{n}")
    created.append(store.backend.create(f"race/{n}", str(me).encode()))
    meet(f"commit{n}")
    manifest = commit(store, float(me), f"{n:064d}")
    won.append([manifest.attempt, load(store, manifest)])
meet("submit")
new = submit(store, BatchManifest.of("b", [BatchEntry("v", "v.mp4")]))[1]
print(json.dumps({"created": created, "won": won, "new": new}))
"""


def test_of_racing_processes_exactly_one_creates_and_commits_and_submits(server: int, url: str, tmp_path: Path) -> None:
    workers, rounds = 3, 3
    paths = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    endpoint = {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{server}", **CREDENTIALS}
    environment = {**os.environ, **endpoint, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    arguments = [url, str(tmp_path)]
    running = [
        subprocess.Popen(
            [sys.executable, "-c", WORKER, *arguments, str(me), str(workers), str(rounds)],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        for me in range(workers)
    ]
    results = [json.loads(process.communicate()[0]) for process in running]
    store = open_s3(url, tmp_path)
    for n in range(rounds):
        creators = [me for me, result in enumerate(results) if result["created"][n]]
        assert len(creators) == 1 and store.backend.read(f"race/{n}") == str(creators[0]).encode()
        manifest = store.lookup(f"{n:064d}")
        assert manifest is not None
        assert {tuple(result["won"][n]) for result in results} == {(manifest.attempt, load(store, manifest))}
        assert len(store.backend.names(f"artifacts/toy/{n:064d}/attempts")) == 1
    assert [result["new"] for result in results].count(True) == 1


def test_a_lease_on_s3_is_held_by_one_and_given_back(url: str, tmp_path: Path) -> None:
    store = open_s3(url, tmp_path)
    with store.lease(KEY, "first", 60) as first, store.lease(KEY, "second", 60) as second:
        assert first and not second
    assert store.backend.files("leases") == []


def test_rows_appended_and_merged_on_s3_are_all_there_once(url: str, tmp_path: Path) -> None:
    tables = Tables(open_s3(url, tmp_path))
    for frame in range(5):
        tables.append("frames", [{**ROW, "frame": frame}], batch="b")
    assert tables.compact("frames", "b") == 5
    tables.append("frames", [{**ROW, "frame": 5}], batch="b")
    assert Tables(open_s3(url, tmp_path)).read("frames", "b")["frame"].to_pylist() == list(range(6))


def test_a_bucket_that_is_not_there_is_named_and_not_made(bucket: str, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"no-such-bucket.*create it, or check --store"):
        open_s3("s3://no-such-bucket/store", tmp_path)
    assert not fsspec.filesystem("s3").exists("no-such-bucket")


def cut_after(changes: int, how: str = "cut", for_good: bool = True) -> tuple[Callable[[str, str], str], list[int]]:
    """A plan under which `changes` requests that change something pass and the next (and all after it) fails."""
    count = [0]

    def plan(method: str, path: str) -> str:
        if method not in CHANGES:
            return how if for_good and count[0] > changes else "pass"
        count[0] += 1
        broken = count[0] > changes if for_good else count[0] == changes + 1
        return how if broken else "pass"

    return plan, count


@pytest.mark.parametrize("how", ["cut", "lose"])
def test_a_power_cut_before_or_after_any_write_of_a_commit_leaves_nothing_or_everything(
    url: str, proxy: Proxy, tmp_path: Path, how: str
) -> None:
    store = open_s3(url, tmp_path)
    outcomes = []
    for step in range(20):
        key = f"{step:064d}"
        proxy.plan, count = cut_after(step, how)
        try:
            commit(store, 1.0, key)
            survived = True
        except OSError:
            survived = False
        proxy.plan = lambda method, path: "pass"
        found = store.lookup(key)
        outcomes.append(found is not None)
        assert load(store, found or commit(store, 1.0, key)) == 1.0, "the rerun has to succeed"
        if survived and count[0] <= step:
            break
    else:
        pytest.fail("the commit never finished")
    assert len(outcomes) >= 4 and {True, False} == set(outcomes)  # two blobs and a manifest at the least
    store.gc(-1)
    assert len(objects(store)) == 3 * len(outcomes), "orphans are collected"
    assert not list((tmp_path / "cache" / "scratch").iterdir())


def test_a_power_cut_at_any_write_of_a_merge_loses_and_doubles_no_row(url: str, proxy: Proxy, tmp_path: Path) -> None:
    store = open_s3(url, tmp_path)
    for step in range(30):
        batch = f"b{step}"
        tables = Tables(store)
        tables.append("frames", [{**ROW, "frame": 0}], batch=batch)
        tables.append("frames", [{**ROW, "frame": 1}], batch=batch)
        proxy.plan, count = cut_after(step)
        try:
            tables.compact("frames", batch)
            survived = True
        except OSError:
            survived = False
        proxy.plan = lambda method, path: "pass"
        assert Tables(store).read("frames", batch)["frame"].to_pylist() == [0, 1]
        Tables(store).compact("frames", batch)
        assert Tables(store).read("frames", batch)["frame"].to_pylist() == [0, 1]
        if survived and count[0] <= step:
            assert step >= 4  # merged file, index, two deletions
            return
    pytest.fail("the merge never finished")


@pytest.mark.parametrize("how", ["error", "lose", "cut", "hang"])
def test_one_fault_at_any_request_of_a_commit_is_survived_or_said_and_never_seen_twice(
    url: str, proxy: Proxy, tmp_path: Path, how: str
) -> None:
    patient = open_s3(url, tmp_path)
    if how == "hang":
        use(proxy.url, read_timeout=1)
    store = open_store(url, tmp_path / "cache")
    for step in range(3):
        key = f"{step:064d}"
        proxy.plan, _ = cut_after(step, how, for_good=False)
        try:
            manifest = commit(store, 1.0, key)
        except (OSError, StoreError):
            manifest = None
        proxy.plan = lambda method, path: "pass"
        found = patient.lookup(key)
        if manifest is not None:
            assert found == manifest, "what was said to be committed is there"
        assert load(patient, found or commit(patient, 1.0, key)) == 1.0
        names = patient.backend.names(f"artifacts/toy/{key}")
        assert len([name for name in names if name.startswith("manifest")]) == 1


def test_the_lost_answer_to_a_write_that_arrived_is_not_taken_for_a_rival(
    url: str, proxy: Proxy, tmp_path: Path
) -> None:
    store = open_s3(url, tmp_path)
    lost: list[str] = []

    def lose_once(method: str, path: str) -> str:
        if method == "PUT" and path.endswith(".json") and path not in lost:
            lost.append(path)
            return "lose"
        return "pass"

    proxy.plan = lose_once
    manifest = commit(store, 1.0)
    assert store.lookup(KEY) == manifest and any("manifest.0001" in path for path in lost)
    assert submit(store, BatchManifest.of("b", [BatchEntry("v", "v.mp4")]))[1], "ours, though S3 said it was there"
    tables = Tables(store)
    for frame in range(3):
        tables.append("frames", [{**ROW, "frame": frame}], batch="b")
    assert tables.compact("frames", "b") == 3
    assert Tables(store).read("frames", "b")["frame"].to_pylist() == [0, 1, 2]
    assert read_batch(store, "b").entries[0].video_id == "v"


def test_slow_reads_arrive_whole_and_short_ones_are_never_taken_for_whole(
    url: str, proxy: Proxy, tmp_path: Path
) -> None:
    store = open_s3(url, tmp_path)
    manifest = commit(store, 3.0)
    proxy.plan = lambda method, path: "slow" if method == "GET" else "pass"
    assert store.lookup(KEY) == manifest and load(store, manifest) == 3.0
    proxy.plan = lambda method, path: "short" if method == "GET" and path.endswith(".npz") else "pass"
    fresh = open_s3(url, tmp_path / "fresh")
    with pytest.raises((OSError, CorruptError)):
        fresh.fetch(manifest, "points.npz")
    assert not [path for path in (tmp_path / "fresh").rglob("*") if path.is_file()]
    proxy.plan = lambda method, path: "pass"
    assert load(fresh, manifest) == 3.0


def test_a_server_that_is_down_is_an_error_and_not_an_empty_store(url: str, proxy: Proxy, tmp_path: Path) -> None:
    store = open_s3(url, tmp_path)
    commit(store)
    proxy.plan = lambda method, path: "error"
    for use_it in (lambda: store.lookup(KEY), lambda: Tables(store).read("frames", "b")):
        with pytest.raises(StoreUnavailableError, match="try again later"):
            use_it()


def test_an_object_store_that_is_full_says_so_and_keeps_nothing(url: str, proxy: Proxy, tmp_path: Path) -> None:
    store = open_s3(url, tmp_path)
    proxy.plan = lambda method, path: "full" if method == "PUT" else "pass"
    with pytest.raises(StoreFullError, match=r"no room left for s3://.*free some space") as caught:
        commit(store)
    assert caught.value.needed > 0
    proxy.plan = lambda method, path: "pass"
    assert store.lookup(KEY) is None and objects(store) == []


class Careless(s3fs.S3FileSystem):
    """An S3 look-alike that does not know If-None-Match."""

    protocol = "careless-s3"

    async def _pipe_file(self, path: str, data: bytes, mode: str = "overwrite", **kwargs: Any) -> Any:
        return await super()._pipe_file(path, data, **kwargs)


def test_an_s3_that_ignores_the_condition_is_refused_for_several_workers(bucket: str, tmp_path: Path) -> None:
    fsspec.register_implementation("careless-s3", Careless, clobber=True)
    fsspec.config.conf["careless-s3"] = fsspec.config.conf["s3"]
    with pytest.raises(StoreError, match="only if it is absent"):
        ArtifactStore(f"careless-s3://{bucket}/store", workers=2, artifacts=ARTIFACTS)
    one = open_store(f"careless-s3://{bucket}/store", tmp_path)
    assert one.lookup(commit(one).key) is not None


def test_without_the_package_the_error_names_the_extra(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['s3fs'] = None\n"
        "from storage_schema.store import ArtifactStore; ArtifactStore('s3://me:hunter2@bucket/store')"
    )
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=Path(__file__).parents[2]
    )
    assert answer.returncode == 1 and "ahoy-avatars[s3]" in answer.stderr
    assert "hunter2" not in answer.stderr.splitlines()[-1]


def test_attempts_that_are_being_written_to_s3_are_not_collected_by_a_clock_that_is_wrong(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_s3(url, tmp_path)
    live = f"artifacts/toy/{KEY}/attempts/live/points.npz"
    store.backend.write(live, b"half")
    real = time.time
    monkeypatch.setattr("storage_schema.backend.time.time", lambda: real() + 7 * 86400)
    assert store.gc(3600) == [] and store.backend.files("artifacts") == [live]
