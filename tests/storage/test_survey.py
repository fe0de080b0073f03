"""What is damaged is found, named and taken out of the way; what is too old is upgraded; nothing else is touched."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from typer.testing import CliRunner

from flows.cli import app
from storage_schema import batches, manifest, migrate, survey
from storage_schema.batches import BatchEntry, BatchManifest, read_batch, submit
from storage_schema.manifest import SCHEMA_VERSION, manifest_name
from storage_schema.repair import _disjoint, repair
from storage_schema.schemas import TABLES
from storage_schema.store import ArtifactStore
from storage_schema.survey import Finding
from storage_schema.tables import Tables

from .toy import KEY, commit, load, open_store

ROW = {"video_id": "v", "key": "k", "frame": 0, "index": 0, "pts": 0.0, "used": True, "confidence": 1.0}
FOLDER = "tables/frames/batch=b"
OTHER = "0" * 64


def filled(store: ArtifactStore) -> Tables:
    """Two artifacts, a batch, and frames 0..5: four of them merged."""
    commit(store, 1.0)
    commit(store, 2.0, OTHER)
    submit(store, BatchManifest.of("b", [BatchEntry("v", "v.mp4")]))
    tables = Tables(store)
    for frame in range(4):
        tables.append("frames", [{**ROW, "frame": frame}], batch="b")
    tables.compact("frames", "b")
    for frame in (4, 5):
        tables.append("frames", [{**ROW, "frame": frame}], batch="b")
    return tables


def frames(store: ArtifactStore) -> list[int]:
    return Tables(store).read("frames", "b")["frame"].to_pylist()


def half(store: ArtifactStore, path: str) -> None:
    data = store.backend.read(path)
    store.backend.write(path, data[: len(data) // 2])


def first(store: ArtifactStore, folder: str) -> str:
    return store.backend.files(folder)[0]


def test_a_whole_store_has_no_findings_and_everything_is_counted(store: ArtifactStore) -> None:
    filled(store)
    found = survey.survey(store)
    assert found.findings == () and found.orphans == ()
    assert found.counts["artifacts"] == 2 and found.counts["blobs"] == 4 and found.counts["batches"] == 1
    assert found.counts["rows"] == 6 and found.counts["table_files"] == 3 and found.counts["outdated"] == 0


def damage_blob(store: ArtifactStore) -> None:
    half(store, first(store, f"artifacts/toy/{KEY}/attempts"))


def damage_manifest(store: ArtifactStore) -> None:
    half(store, f"artifacts/toy/{KEY}/{manifest_name(1)}")


def damage_batch(store: ArtifactStore) -> None:
    half(store, "batches/b/manifest.json")


def damage_appended(store: ArtifactStore) -> None:
    half(store, first(store, FOLDER))


def damage_merged(store: ArtifactStore) -> None:
    half(store, first(store, f"{FOLDER}/merged"))


def remove_merged(store: ArtifactStore) -> None:
    store.backend.remove(first(store, f"{FOLDER}/merged"))


def damage_index(store: ArtifactStore) -> None:
    half(store, f"{FOLDER}/index/000001.json")


@pytest.mark.parametrize(
    ("damage", "kind", "left"),
    [
        (damage_blob, "artifact", [0, 1, 2, 3, 4, 5]),
        (damage_manifest, "artifact", [0, 1, 2, 3, 4, 5]),
        (damage_batch, "batch", [0, 1, 2, 3, 4, 5]),
        (damage_appended, "table", [0, 1, 2, 3, 5]),
        (damage_merged, "table", [4, 5]),
        (remove_merged, "table", [4, 5]),
        (damage_index, "index", [0, 1, 2, 3, 4, 5]),
    ],
)
def test_damage_of_every_kind_is_found_and_repaired_and_nothing_else_is_lost(
    store: ArtifactStore, damage: Callable[[ArtifactStore], None], kind: str, left: list[int]
) -> None:
    filled(store)
    damage(store)
    found = survey.survey(store)
    assert [finding.kind for finding in found.findings] == [kind]
    assert repair(store, found.findings) == ()
    assert survey.survey(store).findings == ()
    assert frames(store) == left
    assert load(store, store.lookup(OTHER) or commit(store, 0.0)) == 2.0
    assert load(store, commit(store, 3.0)) == (3.0 if kind == "artifact" else 1.0)
    assert (kind == "batch") == submit(store, BatchManifest.of("b", [BatchEntry("v", "v.mp4")]))[1]
    assert damage is remove_merged or kind == "index" or store.backend.files("damaged"), "kept for a person to look at"


def test_an_index_is_made_anew_from_the_files_that_hold_what_was_merged_though_others_lie_beside_them(
    store: ArtifactStore,
) -> None:
    tables = filled(store)
    partition = tables._partition("frames", "b")
    snapshot = partition.snapshot()
    # What a lost merge leaves: a file with rows of which some are merged and some are still appended.
    partition._write_merged(list(snapshot.parts.items())[1:])
    tables.append("frames", [{**ROW, "frame": 6}], batch="b")
    tables.append("frames", [{**ROW, "frame": 7}], batch="b")
    assert tables.compact("frames", "b")
    half(store, f"{FOLDER}/index/{partition.head():06d}.json")
    repair(store, survey.survey(store).findings)
    assert sorted(frames(store)) == list(range(8))


def test_files_that_share_an_append_are_never_put_in_force_together() -> None:
    sources = {"x": frozenset("ab"), "y": frozenset("c"), "z": frozenset("bc")}
    assert _disjoint(sources, frozenset()) == ("x", "y"), "x and z cover as much, and b twice"
    assert _disjoint(sources, frozenset("a")) in (("x", "y"), ("z",)), "a is still there as its own file"


def test_what_a_newer_version_wrote_is_found_and_left_alone(store: ArtifactStore) -> None:
    filled(store)
    newer = {n: replace(s, version=9, upgrades=dict.fromkeys(range(1, 9), lambda t: t)) for n, s in TABLES.items()}
    Tables(store, newer).append("frames", [ROW], batch="b")
    document = replace(commit(store), schema_version=SCHEMA_VERSION + 1).to_json()
    store.backend.write(f"artifacts/toy/{KEY}/{manifest_name(1)}", document)
    store.backend.write(
        "batches/c/manifest.json", replace(read_batch(store, "b"), batch="c", schema_version=9).to_json()
    )
    store.backend.write("tables/hologram/batch=b/x.parquet", b"?")
    before = {path: store.backend.read(path) for path in store.backend.files("")}
    found = survey.survey(store).findings
    assert sorted(finding.kind for finding in found) == ["newer", "newer", "newer", "unknown"]
    assert len(repair(store, found)) == 4
    assert {path: store.backend.read(path) for path in store.backend.files("")} == before


def test_orphans_of_all_kinds_are_collected_when_they_are_old_and_not_before(store: ArtifactStore) -> None:
    tables = filled(store)
    partition = tables._partition("frames", "b")
    partition._write_merged(list(partition.snapshot().parts.items())[1:])
    store.backend.write(f"artifacts/toy/{KEY}/attempts/killed/points.npz", b"half")
    store.backend.write("leases/x/0001.json", json.dumps({"expires_at": 1.0}).encode())
    store.backend.write("damaged/batches/b/manifest.json", b"half")
    assert store.gc(3600) == []
    dry = store.gc(-1, dry_run=True)
    assert len(dry) == 4 and store.gc(-1) == dry and store.gc(-1) == []
    assert survey.survey(store).findings == () and frames(store) == [0, 1, 2, 3, 4, 5]


def test_stores_of_older_versions_are_upgraded_once_and_say_the_same_afterwards(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = [column for column in TABLES["stages"].columns if column.name not in ("attempt_number", "seq")]
    old = replace(TABLES["stages"], version=1, columns=pa.schema(columns), upgrades={})
    row = {"video_id": "v", "run_id": "r", "stage": "s", "stage_version": 1, "state": "done", "wall_s": 1.0}
    Tables(store, {"stages": old}).append("stages", [{**row, "started_at": "2026-01-01T00:00:00+00:00"}], batch="b")
    filled(store)
    whole, batch = store.lookup(KEY), read_batch(store, "b")
    rows = Tables(store).read("stages")
    for module, name in ((manifest, "SCHEMA_VERSION"), (migrate, "SCHEMA_VERSION"), (survey, "SCHEMA_VERSION")):
        monkeypatch.setattr(module, name, 2)
    for module in (batches, migrate):
        monkeypatch.setattr(module, "BATCH_VERSION", 2)
    monkeypatch.setattr(manifest, "UPGRADES", {1: lambda body: {**body, "summary": {**body["summary"], "new": 1}}})
    monkeypatch.setattr(batches, "UPGRADES", {1: lambda body: {**body, "defaults": {"new": 1}}})
    expected = {"tables": 1, "batches": 1, "artifacts": 2}
    assert migrate.migrate(store, dry_run=True) == expected == migrate.migrate(store, dry_run=True)
    assert survey.survey(store).counts["outdated"] == 3
    assert migrate.migrate(store) == expected
    assert migrate.migrate(store) == {"tables": 0, "batches": 0, "artifacts": 0}
    assert survey.survey(store).counts["outdated"] == 0 and survey.survey(store).findings == ()
    assert whole is not None and store.lookup(KEY) == replace(
        whole, schema_version=2, summary={**whole.summary, "new": 1}
    )
    assert read_batch(store, "b") == replace(batch, schema_version=2, defaults={"new": 1})
    assert Tables(store).read("stages") == rows


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["store", *arguments])


def test_the_command_line_says_what_is_damaged_by_its_exit_status(tmp_path: Path) -> None:
    url = str(tmp_path / "store")
    store = open_store(url)
    tables = filled(store)
    assert run("check", url).exit_code == 0
    half(store, first(store, FOLDER))
    store.backend.write(f"artifacts/toy/{KEY}/attempts/killed/points.npz", b"half")
    broken = run("check", url)
    assert broken.exit_code == 4 and "damaged: 1 table" in broken.output
    plain = json.loads(run("check", url, "--json").output)
    assert plain["left"] == 1 and plain["findings"][0]["kind"] == "table" and plain["counts"]["artifacts"] == 2
    assert run("check", url, "--repair").exit_code == 0 and run("check", url).exit_code == 0
    dry = json.loads(run("gc", url, "--older-than", "0s", "--dry-run", "--json").output)
    assert {orphan["kind"] for orphan in dry["deleted"]} == {"attempt", "damaged file"}
    assert "0 in all" in run("gc", url).output
    assert "2 in all" in run("gc", url, "--older-than", "0s").output
    assert "upgraded: 0 tables, 0 batches, 0 artifacts" in run("migrate", url).output
    assert run("gc", url, "--older-than", "soon").exit_code == 2
    assert tables.read("frames", "b").num_rows == 5


def test_an_unusable_store_is_one_line_and_an_exit_status(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").touch()
    answer = run("check", str(tmp_path / "clip.mp4"))
    assert answer.exit_code == 2 and answer.output.startswith("error:") and "is a file" in answer.output


def test_findings_are_plain_data(store: ArtifactStore) -> None:
    filled(store)
    damage_blob(store)
    found = json.loads(json.dumps(survey.survey(store).to_json()))
    assert Finding(**found["findings"][0]).kind == "artifact"
