"""DensePose's charts on our body: the table, its points on other bodies, and frames moved to them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.io import savemat

from ahoy_core.body.load import load_body
from ahoy_core.body.model import BodyModel
from ahoy_core.body.packaged import load_packaged_body
from ahoy_core.body.register import vertices_on
from ahoy_core.formats.densepose import ChartTable, read_chart_table
from ahoy_core.formats.errors import BodyFileError
from ahoy_core.models.contracts import Charts
from ahoy_core.models.errors import CheckpointError
from ahoy_core.texture.by_roles import charts_on, dense_by
from ahoy_core.texture.dense import chart_map, words_of_faces
from ahoy_core.texture.inputs import TextureConfig
from ahoy_core.texture.rays import Caster, hit_map, to_camera
from ahoy_core.texture.surface import Surface
from ahoy_core.texture.texels import texel_map
from ahoy_core.texture.texture import build_texture
from tests.body import licensed
from tests.models.charts import parts_of, table_arrays, write_table

from .synthetic import CapsuleBody, pictures, smooth_paint, standing


@pytest.fixture(scope="module")
def smpl(tmp_path_factory: pytest.TempPathFactory) -> BodyModel:
    folder = tmp_path_factory.mktemp("smpl")
    licensed.write_obj(folder / "smpl_uv.obj", "smpl")
    return load_body(str(licensed.write(folder, "smpl")))


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> ChartTable:
    return read_chart_table(write_table(tmp_path_factory.mktemp("table")))


def rest(body: BodyModel) -> np.ndarray:
    still = torch.zeros(1, body.n_joints, 3)
    out: np.ndarray = body(still, body.default_betas[None], still[:, 0]).vertices[0].double().numpy()
    return out


def some_points(table: ChartTable, count: int = 600) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Chart, uv, and the SMPL vertices and weights of points where a chart does not lie over itself.

    The published charts never do; ours, flat projections of tubes, do at their ends.
    """
    rng = np.random.default_rng(0)
    face = rng.integers(len(table.faces), size=count)
    bary = rng.dirichlet((4, 4, 4), size=count)
    uv = (table.uv[table.faces[face]] * bary[..., None]).sum(1)
    once = np.array([_triangles_over(table, table.chart[f], at) == 1 for f, at in zip(face, uv, strict=True)])
    assert once.mean() > 0.5
    return table.chart[face][once], uv[once], table.vertices[table.faces[face]][once], bary[once]


def _triangles_over(table: ChartTable, chart: int, at: np.ndarray) -> int:
    a, b, c = (table.uv[table.faces[table.chart == chart][:, i]] - at for i in range(3))
    turns = [x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0] for x, y in ((a, b), (b, c), (c, a))]
    return int((np.all([t >= 0 for t in turns], 0) | np.all([t <= 0 for t in turns], 0)).sum())


def test_chart_coordinates_are_points_of_the_body_that_the_table_was_made_for(
    smpl: BodyModel, table: ChartTable
) -> None:
    surface, vertices = Surface.of(smpl), rest(smpl)
    charts = charts_on(SimpleNamespace(table=table, smpl=None), smpl, surface)
    assert charts is not None
    chart, uv, corners, bary = some_points(table)
    truth = (vertices[corners] * bary[..., None]).sum(1)
    face, weights = charts.points(chart, uv)
    found = (vertices[surface.faces[face]] * weights[..., None]).sum(1)
    error = np.linalg.norm(found - truth, axis=1)
    # A cell of a chart is up to 8 mm long, a sample of the surface 4 mm away at most; beside a fold of our own charts a
    # cell may belong to the other side of a tube, which is 18 cm thick.
    assert np.median(error) < 0.005 and np.quantile(error, 0.9) < 0.02, np.quantile(error, [0.5, 0.9, 0.99])


@pytest.mark.parametrize("target", ["smplx", "packaged"])
def test_other_bodies_get_the_same_limb_of_the_same_side(
    target: str, smpl: BodyModel, table: ChartTable, tmp_path: Path
) -> None:
    body = load_packaged_body() if target == "packaged" else load_body(str(licensed.write(tmp_path, "smplx")))
    surface, vertices = Surface.of(body), rest(body)
    charts = chart_map(table, vertices_on(smpl, body).double().numpy(), surface, vertices)
    chart, uv, corners, bary = some_points(table)
    face, weights = charts.points(chart, uv)
    theirs = words_of_faces(Surface.of(smpl))
    # What the table's own body calls the triangle that the point is nearest to.
    own = charts_on(SimpleNamespace(table=table, smpl=None), smpl, Surface.of(smpl))
    assert own is not None
    said = theirs[own.points(chart, uv)[0]]
    agreed = words_of_faces(surface)[face] == said
    # Bodies end their hands, heads and feet at other places: those borders are some per cent of the surface.
    assert agreed.mean() > 0.85, {w: agreed[said == w].mean() for w in set(said)}
    point = (vertices[surface.faces[face]] * weights[..., None]).sum(1)
    side = (rest(smpl)[corners] * bary[..., None]).sum(1)[:, 0]
    far = np.abs(side) > 0.15
    assert (np.sign(point[far, 0]) == np.sign(side[far])).mean() > 0.98


def test_a_body_carried_over_to_itself_stays(smpl: BodyModel) -> None:
    assert float((vertices_on(smpl, smpl) - torch.from_numpy(rest(smpl))).abs().max()) < 1e-4


def test_a_table_without_smpls_file_is_refused_where_the_body_is_another(table: ChartTable) -> None:
    body = load_packaged_body()
    with pytest.raises(CheckpointError, match=r"SMPL's own file beside UV_Processed\.mat.*SMPL_NEUTRAL\.npz"):
        charts_on(SimpleNamespace(table=table, smpl=None), body, Surface.of(body))
    assert charts_on(SimpleNamespace(), body, Surface.of(body)) is None


def test_a_wrong_table_is_named(tmp_path: Path) -> None:
    path = tmp_path / "UV_Processed.mat"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(BodyFileError, match="cannot be read as a MATLAB file"):
        read_chart_table(path)
    held = table_arrays()
    savemat(path, {k: v for k, v in held.items() if k != "All_U_norm"})
    with pytest.raises(BodyFileError, match="got no All_U_norm"):
        read_chart_table(path)
    savemat(path, held | {"All_vertices": held["All_vertices"] + 10000})
    with pytest.raises(BodyFileError, match=r"vertices of SMPL \(1 to 6890\)"):
        read_chart_table(path)
    savemat(path, held | {"All_FaceIndices": held["All_FaceIndices"] + 3})
    with pytest.raises(BodyFileError, match="charts 1 to 24"):
        read_chart_table(path)


class TrueDensePose:
    """What a perfect network would say of the capsule person: parts and chart coordinates of the true body."""

    def __init__(self, body: CapsuleBody, fit: dict[str, np.ndarray], table: ChartTable, size: tuple[int, int]) -> None:
        out = body(*(torch.from_numpy(fit[n]) for n in ("pose",)), torch.zeros(1, 1), torch.from_numpy(fit["transl"]))
        surface = Surface.of(body)
        parts, uvs = [], []
        for vertices in out.vertices.numpy():
            caster = Caster(to_camera(vertices, fit["viewmat"]), surface.faces)
            hits = hit_map(caster, fit["K"], size[1], size[0])
            there = hits.face >= 0
            # The table's triangles are the body's, in their order.
            parts.append(np.where(there, table.chart[hits.face], 0).astype(np.uint8))
            uv = (table.uv[table.faces[hits.face]] * hits.bary[..., None]).sum(2)
            uvs.append(np.where(there[..., None], uv, 0).transpose(2, 0, 1).astype(np.float32))
        self.charts = Charts(torch.from_numpy(np.stack(parts)), torch.from_numpy(np.stack(uvs)))
        self.given = 0

    def __call__(self, frames: torch.Tensor, boxes: torch.Tensor) -> Charts:
        rows = slice(self.given, self.given + len(frames))
        self.given += len(frames)
        return Charts(self.charts.part[rows], self.charts.uv[rows])


def capsule_table(body: CapsuleBody) -> ChartTable:
    """The capsules' own triangles as charts: each ellipsoid one, at the UV of its cell."""
    part = {"torso": 1, "head": 23, "arm.L": 15, "arm.R": 16, "hand.L": 3, "hand.R": 4, "leg.L": 7, "leg.R": 8}
    names = body.parts[body.faces[:, 0].numpy()]
    uv = body.uvs.double().numpy()[body.uv_faces.numpy()]
    low = np.floor(uv.mean(1) * [4, 2]) / [4, 2]
    flat = ((uv - low[:, None]) * [4, 2]).reshape(-1, 2).clip(0, 1)
    count = len(body.faces)
    vertices = body.faces.numpy().reshape(-1)
    return ChartTable(vertices, flat, np.arange(3 * count).reshape(-1, 3), np.array([part[n] for n in names]))


def test_frames_of_a_fit_that_is_off_are_read_where_the_charts_say(body: CapsuleBody) -> None:
    """The fit stands 5 pixels beside the person: with the charts the atlas gets the colours that belong there."""
    truth, surface = standing(3), Surface.of(body)
    frames, visible = pictures(body, truth, smooth_paint)
    off = {**truth, "transl": truth["transl"] + np.float32([0.08, 0, 0])}
    table = capsule_table(body)
    role = TrueDensePose(body, truth, table, visible.shape[1:])
    charts = chart_map(table, body.rest.double().numpy(), surface, body.rest.double().numpy())
    boxes = np.tile(np.float32([0, 0, 128, 128]), (3, 1))
    config = TextureConfig(atlas_size=128, align_px=0, canonical_height=64, canonical_width=48)
    texels = texel_map(surface, 128)
    points = texels.points(body.rest.numpy(), surface.faces)
    error, share = {}, {}
    for name, used in (("fit", None), ("charts", charts)):
        role.given = 0
        dense = dense_by(role, surface, frames, boxes, truth["used"], used)
        made = build_texture(frames, visible, off, body, config, canonical=body.rest.numpy(), second=dense)
        seen = made.coverage.ravel()[texels.flat] > 0
        colours = made.observed_rgb.reshape(-1, 3)[texels.flat[seen]].astype(float)
        error[name] = float(np.abs(colours - smooth_paint(points[seen])).mean())
        share[name] = float(seen.mean())
    # 5 pixels are 8 cm; a sideways colour gradient of 2 levels a centimetre makes 16 levels of the red channel alone.
    assert error["charts"] < 0.5 * error["fit"], error
    # Arms are seven pixels wide: beside the person, the fit sees little but the torso.
    assert share["charts"] > 2 * share["fit"] > 0, share
    assert all(3 < pixels < 7 for pixels in dense.moved.values()) and len(dense.moved) == 3


def test_charts_of_the_fit_itself_move_nothing(body: CapsuleBody) -> None:
    truth, surface = standing(1), Surface.of(body)
    frames, visible = pictures(body, truth, smooth_paint)
    table = capsule_table(body)
    charts = chart_map(table, body.rest.double().numpy(), surface, body.rest.double().numpy())
    role = TrueDensePose(body, truth, table, visible.shape[1:])
    dense = dense_by(role, surface, frames, np.float32([[0, 0, 128, 128]]), truth["used"], charts)
    caster = Caster(to_camera(_posed(body, truth), truth["viewmat"]), surface.faces)
    dense.registered(0, caster, truth["K"], frames[0], visible[0])
    assert dense.moved[0] < 0.5, "cells of the charts are about as large as a pixel"


def _posed(body: CapsuleBody, fit: dict[str, np.ndarray]) -> np.ndarray:
    out = body(torch.from_numpy(fit["pose"]), torch.zeros(1, 1), torch.from_numpy(fit["transl"]))
    vertices: np.ndarray = out.vertices[0].numpy()
    return vertices


def test_the_synthetic_table_has_all_charts() -> None:
    assert set(parts_of().tolist()) == set(range(1, 25))
