"""A cell on a capture that the avatar itself made: every protocol must give the avatar back, and notice what is off."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from ahoy_core.captures.capture import Capture
from ahoy_core.formats.images import to_uint8, write_png
from ahoy_core.metrics.protocol import PROTOCOLS
from ahoy_core.metrics.score import Made
from tasks.evaluation import cell as cell_module
from tasks.evaluation.cell import COLUMNS, _run, as_stored
from tasks.evaluation.config import EvaluateConfig
from tasks.evaluation.fitted import Fitted
from tasks.evaluation.folders import FolderRenderer, renders_source
from tasks.evaluation.renderers import AvatarRenderer, Renderer, reference
from tasks.evaluation.truths import Truths
from tasks.evaluation.withhold import withheld
from tasks.stage import StageContext
from tests.evaluation import people


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Fitted]:
    capture = people.capture(tmp_path_factory.mktemp("capture"))
    return capture, people.fitted(capture)


def _rows(
    capture: Capture, fitted: Fitted, renderer: Renderer, out: Path, every: int | None = None, **knobs: object
) -> list[dict]:
    config = EvaluateConfig.model_validate({"capture": "made", "config": "full", "size": people.SIZE, **knobs})
    ctx = StageContext({}, {}, out, lambda done, total, note="": None)
    _run(config, ctx, Truths(capture, fitted, config.size, every), renderer)
    return pq.read_table(out / "metrics.parquet").to_pylist()


def _mean(rows: list[dict], protocol: str, region: str = "box") -> float:
    found = [row["psnr"] for row in rows if row["protocol"] == protocol and row["region"] == region]
    assert found, (protocol, region)
    return float(np.mean(found))


def _avatar(capture: Capture, fitted: Fitted) -> AvatarRenderer:
    return AvatarRenderer(people.avatar(), people.body(), capture, fitted)


@pytest.fixture(scope="module")
def rows(made: tuple[Capture, Fitted], tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    return _rows(*made, _avatar(*made), tmp_path_factory.mktemp("cell"))


def test_the_avatar_that_made_the_truth_scores_as_high_as_eight_bits_allow(rows: list[dict]) -> None:
    for protocol in ("novel-view-gt", "novel-pose-gt", "input-camera-gt"):
        assert _mean(rows, protocol) > 45, protocol
    # A similarity was fitted in between, and the input's frames are 8-bit too.
    assert _mean(rows, "novel-view-est") > 40 and _mean(rows, "input-view") > 40


def test_each_protocol_looks_through_its_own_cameras_at_its_own_frames(rows: list[dict]) -> None:
    seen = {p: {(r["camera"], r["frame"]) for r in rows if r["protocol"] == p} for p in PROTOCOLS}
    assert seen["novel-view-gt"] == seen["novel-view-est"] == {("side", 0), ("side", 3)}
    assert seen["novel-pose-gt"] == {("side", 0), ("side", 2)}
    assert seen["input-camera-gt"] == {("front", 0), ("front", 3)}
    assert seen["input-view"] == {("front", t) for t in range(5)}  # frame 5 was not fitted
    assert not seen["held-out-frame"]


def test_rows_have_the_columns_and_ids_differ_by_protocol_region_and_size(
    rows: list[dict], made: tuple[Capture, Fitted], tmp_path: Path
) -> None:
    assert tuple(rows[0]) == COLUMNS
    ids = {(row["protocol"], row["region"]): row["protocol_id"] for row in rows}
    assert len(set(ids.values())) == len(ids)
    smaller = _rows(*made, _avatar(*made), tmp_path, size=48, protocols=("novel-view-gt",))
    assert not {row["protocol_id"] for row in smaller} & set(ids.values())
    box = [row for row in smaller if row["region"] == "box"]
    # Truth filtered down against a render of that size: not equal, but a camera left unscaled would miss the person.
    assert box and all("size=48x48" in row["protocol_id"] and row["psnr"] > 20 for row in box)


def test_a_wrong_avatar_scores_less_in_the_region_where_it_is_wrong(
    made: tuple[Capture, Fitted], rows: list[dict], tmp_path: Path
) -> None:
    good = people.avatar()
    colors = good.colors.clone()
    colors[good.head] = 0.0
    wrong = AvatarRenderer(replace(good, colors=colors), people.body(), *made)
    found = _rows(*made, wrong, tmp_path, protocols=("novel-view-gt",))
    assert _mean(found, "novel-view-gt", "head") < _mean(rows, "novel-view-gt", "head") - 10
    assert _mean(found, "novel-view-gt", "head") < _mean(found, "novel-view-gt", "box")


def test_a_pose_or_place_that_is_off_shows(made: tuple[Capture, Fitted], rows: list[dict], tmp_path: Path) -> None:
    capture, fitted = made

    class Late(AvatarRenderer):
        def _pose(self, shot):  # type: ignore[no-untyped-def]
            pose, transl = super()._pose(shot)
            return pose, transl + torch.tensor([0.0, 0.05, 0.0])

    found = _rows(capture, fitted, Late(people.avatar(), people.body(), capture, fitted), tmp_path)
    assert _mean(found, "novel-view-gt") < _mean(rows, "novel-view-gt") - 10


def test_one_similarity_takes_a_constant_error_out_and_not_one_that_changes(
    made: tuple[Capture, Fitted], rows: list[dict], tmp_path: Path
) -> None:
    capture, fitted = made
    drifting = replace(
        fitted, transl=fitted.transl + 0.1 * torch.arange(people.COUNT)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    )
    found = _rows(capture, drifting, _avatar(capture, drifting), tmp_path, protocols=("novel-view-est",))
    assert _mean(found, "novel-view-est") < _mean(rows, "novel-view-est") - 10


def test_references_need_no_avatar_and_score_below_it(
    made: tuple[Capture, Fitted], rows: list[dict], tmp_path: Path
) -> None:
    for number, name in enumerate(("reference: shifted 2 px", "reference: flat colour")):
        out = tmp_path / str(number)
        out.mkdir()
        found = _rows(*made, reference(name), out, config=name)
        assert 5 < _mean(found, "novel-view-gt") < _mean(rows, "novel-view-gt") - 5
    with pytest.raises(ValueError, match="shifted"):
        reference("reference: none")


def test_withheld_frames_are_what_a_plain_video_is_scored_on(made: tuple[Capture, Fitted], tmp_path: Path) -> None:
    capture, fitted = made
    plain = replace(capture, views=(), bodies={}, cameras={}, kind="videos")
    found = _rows(plain, fitted, AvatarRenderer(people.avatar(), people.body(), plain, fitted), tmp_path, every=2)
    assert withheld(fitted.used, 2) == [1, 3]
    assert {row["frame"] for row in found if row["protocol"] == "held-out-frame"} == {1, 3}
    assert {row["frame"] for row in found if row["protocol"] == "input-view"} == {0, 2, 4}
    assert _mean(found, "held-out-frame") > 40
    notes = json.loads((tmp_path / "cell.json").read_text())["notes"]
    assert any(note.startswith("novel-view-gt left out") for note in notes)


def test_a_picture_that_is_not_given_is_noted_and_a_broken_one_is_not_scored_as_dark(
    made: tuple[Capture, Fitted], tmp_path: Path
) -> None:
    found = _rows(*made, lambda shot: None, tmp_path, protocols=("novel-view-gt",))
    assert not found and "no picture was given" in (tmp_path / "cell.json").read_text()
    with pytest.raises(ValueError, match="finite picture"):
        as_stored(Made(torch.full((3, 4, 4), float("nan")), None))


def test_unknown_protocols_are_refused() -> None:
    with pytest.raises(ValueError, match="novel-view-gt"):
        EvaluateConfig(capture="c", config="full", protocols=("best-view",))


def test_the_perceptual_net_is_named_in_row_and_id(
    made: tuple[Capture, Fitted], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Net:
        name = "L1-net"

        def __call__(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            return (a - b).abs().flatten(1).mean(1)

    monkeypatch.setattr(cell_module, "perceptual_network", lambda fills: Net())
    monkeypatch.setattr("ahoy_core.metrics.score.MIN_SIDE", 8)  # the person is 20 pixels wide here
    found = _rows(*made, reference("reference: flat colour"), tmp_path, protocols=("novel-view-gt",))
    by_region: Mapping[str, dict] = {row["region"]: row for row in found}
    assert by_region["box"]["perceptual"] > 0 and by_region["box"]["perceptual_name"] == "L1-net"
    assert by_region["mask"]["perceptual"] is None and by_region["mask"]["perceptual_name"] is None
    assert "perceptual=L1-net, input [0,1]" in by_region["box"]["protocol_id"]


def test_renders_of_another_system_score_as_the_same_pictures_of_ours(
    made: tuple[Capture, Fitted], rows: list[dict], tmp_path: Path
) -> None:
    capture, fitted = made
    home, renderer = tmp_path / "other" / "made", _avatar(capture, fitted)
    truths = Truths(capture, fitted, people.SIZE, None)

    for view in truths.views("novel-view-gt")[0]:
        shot = truths.shot("novel-view-gt", view)
        assert shot is not None
        picture = renderer(shot)
        assert picture.alpha is not None
        straight = (picture.rgb - 0.5 * (1 - picture.alpha)) / picture.alpha.clamp(min=1e-3)
        path = home / "novel-view-gt" / f"{view.camera}_{view.frame:03d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, to_uint8(torch.cat([straight.clamp(0, 1), picture.alpha[None]])))
    (home / "novel-view-gt" / "side_003.png").unlink()
    found = _rows(capture, fitted, FolderRenderer(home), tmp_path, protocols=("novel-view-gt",))
    assert {row["frame"] for row in found} == {0} and _mean(found, "novel-view-gt") > 40  # 8-bit straight alpha
    assert "side, frame 3: no picture was given" in (tmp_path / "cell.json").read_text()
    before = renders_source(tmp_path / "other", "made").content_hash
    with pytest.raises(ValueError, match="got none"):
        renders_source(tmp_path / "other", "nobody")
    write_png(home / "novel-view-gt" / "side_000.png", np.zeros((8, 8, 3), np.uint8))
    assert renders_source(tmp_path / "other", "made").content_hash != before
    with pytest.raises(ValueError, match="render at it"):
        _rows(capture, fitted, FolderRenderer(home), tmp_path, protocols=("novel-view-gt",))
