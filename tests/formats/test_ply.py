"""Gaussians survive the way through `.ply`, and viewers find the layout they expect."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ahoy_core.formats.errors import PlyError
from ahoy_core.formats.ply import MIN_SCALE, OPACITY_MARGIN, SH_C0, read_ply, write_ply
from ahoy_core.splat.gaussians import Gaussians

STANDARD = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
STANDARD += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def random_gaussians(count: int, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    quats = torch.randn(count, 4, generator=generator)
    return Gaussians(
        means=torch.randn(count, 3, generator=generator) * 3,
        quats=torch.nn.functional.normalize(quats, dim=-1),
        scales=10 ** (torch.rand(count, 3, generator=generator) * 8 - 7),
        opacities=torch.rand(count, generator=generator),
        colors=torch.rand(count, 3, generator=generator) * 1.4 - 0.2,
    )


def assert_same(a: Gaussians, b: Gaussians) -> None:
    assert torch.equal(a.means, b.means)
    torch.testing.assert_close(a.quats, b.quats, rtol=0, atol=2e-7)
    # A float32 logarithm of magnitude up to 23 has a step of 2e-6, which is the relative error of the scale.
    torch.testing.assert_close(a.scales, b.scales, rtol=3e-6, atol=0)
    torch.testing.assert_close(a.opacities, b.opacities, rtol=0, atol=2 * OPACITY_MARGIN)
    torch.testing.assert_close(a.colors, b.colors, rtol=0, atol=3e-7)


def header_of(path: Path) -> list[str]:
    return path.read_bytes().split(b"end_header\n")[0].decode().splitlines()


def rows_of(path: Path, columns: int) -> np.ndarray:
    return np.frombuffer(path.read_bytes().split(b"end_header\n", 1)[1], "<f4").reshape(-1, columns)


def write_text(path: Path, names: list[str], rows: np.ndarray, kind: str = "float") -> None:
    lines = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(rows)}",
        *(f"property {kind} {n}" for n in names),
        "end_header",
    ]
    lines += [" ".join(repr(float(value)) for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")


@settings(deadline=None, max_examples=25)
@given(count=st.integers(0, 40), seed=st.integers(0, 1000))
def test_round_trip_is_exact_up_to_float32(tmp_path_factory: pytest.TempPathFactory, count: int, seed: int) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    gaussians = random_gaussians(count, seed)
    write_ply(path, gaussians)
    assert_same(read_ply(path).gaussians, gaussians)


def test_second_round_trip_changes_nothing_more(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", random_gaussians(200))
    once = read_ply(tmp_path / "a.ply").gaussians
    write_ply(tmp_path / "b.ply", once)
    assert torch.equal(read_ply(tmp_path / "b.ply").gaussians.scales.log(), once.scales.log())
    assert_same(read_ply(tmp_path / "b.ply").gaussians, once)


def test_layout_is_the_standard_one_with_extras_last(tmp_path: Path) -> None:
    gaussians = random_gaussians(3)
    write_ply(tmp_path / "a.ply", gaussians, {"observed": torch.tensor([0.0, 0.5, 1.0])}, ["made by a test"])
    assert header_of(tmp_path / "a.ply") == [
        "ply", "format binary_little_endian 1.0", "comment made by a test", "element vertex 3",
        *(f"property float {name}" for name in [*STANDARD, "observed"]),
    ]  # fmt: skip
    rows = rows_of(tmp_path / "a.ply", len(STANDARD) + 1)
    column = dict(zip([*STANDARD, "observed"], rows.T, strict=True))
    assert np.allclose(column["x"], gaussians.means[:, 0]) and not column["nx"].any()
    assert np.allclose(column["f_dc_1"], (gaussians.colors[:, 1] - 0.5) / SH_C0)
    assert np.allclose(column["opacity"], torch.logit(gaussians.opacities), atol=1e-5)
    assert np.allclose(column["scale_2"], gaussians.scales[:, 2].log())
    assert np.allclose(column["rot_0"], gaussians.quats[:, 0]) and np.allclose(column["rot_3"], gaussians.quats[:, 3])
    assert column["observed"].tolist() == [0, 0.5, 1]


def test_extras_and_comments_come_back(tmp_path: Path) -> None:
    extra = {"observed": np.linspace(0, 1, 7), "label_id": torch.arange(7)}
    write_ply(tmp_path / "a.ply", random_gaussians(7), extra, ["first line", "synthetic: not a recording"])
    back = read_ply(tmp_path / "a.ply")
    assert list(back.extra) == ["observed", "label_id"]
    assert np.allclose(back.extra["observed"], extra["observed"]) and back.extra["label_id"].tolist() == list(range(7))
    assert back.comments == ("first line", "synthetic: not a recording")


@pytest.mark.parametrize("degree_terms", [3, 8, 15])
def test_higher_harmonics_are_stored_channel_by_channel(tmp_path: Path, degree_terms: int) -> None:
    sh_rest = torch.randn(5, degree_terms, 3, generator=torch.Generator().manual_seed(0))
    write_ply(tmp_path / "a.ply", random_gaussians(5), sh_rest=sh_rest)
    back = read_ply(tmp_path / "a.ply").sh_rest
    assert back is not None and torch.equal(back, sh_rest)
    names = [line.split()[-1] for line in header_of(tmp_path / "a.ply") if line.startswith("property")]
    rows = rows_of(tmp_path / "a.ply", len(names))
    assert np.array_equal(rows[:, names.index("f_rest_1")], sh_rest[:, 1, 0].numpy())
    assert np.array_equal(rows[:, names.index(f"f_rest_{degree_terms}")], sh_rest[:, 0, 1].numpy())


def test_ends_of_the_ranges_stay_finite_within_the_stated_bounds(tmp_path: Path) -> None:
    gaussians = Gaussians(
        means=torch.zeros(4, 3),
        quats=torch.tensor([[0.0, 0, 0, 0], [2.0, 0, 0, 0], [1e-30, 1e-30, 0, 0], [0, 0, 0, -3.0]]),
        scales=torch.tensor([[0.0, 1e-20, 1e3]]).repeat(4, 1),
        opacities=torch.tensor([0.0, 1.0, 1e-9, 0.5]),
        colors=torch.zeros(4, 3),
    )
    write_ply(tmp_path / "a.ply", gaussians)
    assert np.isfinite(rows_of(tmp_path / "a.ply", len(STANDARD))).all()
    back = read_ply(tmp_path / "a.ply").gaussians
    assert torch.allclose(back.opacities, gaussians.opacities, rtol=0, atol=1.3 * OPACITY_MARGIN)
    assert back.opacities.min() > 0 and back.opacities.max() < 1
    torch.testing.assert_close(back.scales[0], torch.tensor([MIN_SCALE, MIN_SCALE, 1e3]), rtol=3e-6, atol=0)
    half = 0.5**0.5
    expected = torch.tensor([[1.0, 0, 0, 0], [1, 0, 0, 0], [half, half, 0, 0], [0, 0, 0, -1]])
    torch.testing.assert_close(back.quats, expected)


def shuffled(tmp_path: Path) -> tuple[Gaussians, list[str], np.ndarray]:
    """A valid table whose properties come in another order, without normals and with a stranger among them."""
    gaussians = random_gaussians(6)
    write_ply(tmp_path / "plain.ply", gaussians)
    table = dict(zip(STANDARD, rows_of(tmp_path / "plain.ply", len(STANDARD)).T, strict=True))
    names = [name for name in np.random.default_rng(0).permutation(STANDARD) if not name.startswith("n")]
    names.insert(4, "stranger")
    table["stranger"] = np.arange(6.0)
    return gaussians, names, np.stack([table[name] for name in names], axis=1)


def test_ascii_with_any_order_and_strangers_is_read(tmp_path: Path) -> None:
    gaussians, names, rows = shuffled(tmp_path)
    write_text(tmp_path / "a.ply", names, rows)
    back = read_ply(tmp_path / "a.ply")
    assert_same(back.gaussians, gaussians)
    assert back.extra["stranger"].tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(("order", "sign"), [("big", ">"), ("little", "<")])
@pytest.mark.parametrize(("kind", "code"), [("float", "f4"), ("double", "f8"), ("float32", "f4")])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_either_byte_order_and_width_is_read(
    tmp_path: Path, order: str, sign: str, kind: str, code: str, newline: str
) -> None:
    gaussians, names, rows = shuffled(tmp_path)
    # A camera element before the vertices and a list after them are both skipped.
    lines = [
        "ply",
        f"format binary_{order}_endian 1.0",
        "element camera 2",
        "property uchar id",
        "property float focal",
    ]
    lines += ["element vertex 6", *(f"property {kind} {n}" for n in names)]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    body = struct.pack(f"{sign}BfBf", 1, 2.0, 3, 4.0) + rows.astype(sign + code).tobytes() + b"\x03" + bytes(12)
    (tmp_path / "a.ply").write_bytes(newline.join(lines).encode() + body)
    back = read_ply(tmp_path / "a.ply")
    assert_same(back.gaussians, gaussians)
    assert back.extra["stranger"].tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("form", "share"),
    [*((form, share) for form in ("binary", "ascii") for share in (0.0, 0.02, 0.3, 0.9)), ("binary", 0.999)],
)
def test_cut_off_files_are_refused(tmp_path: Path, form: str, share: float) -> None:
    gaussians, names, rows = shuffled(tmp_path)
    path = tmp_path / "a.ply"
    if form == "ascii":
        write_text(path, names, rows)
    else:
        write_ply(path, gaussians)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(PlyError, match="expected"):
        read_ply(path)


def test_forged_count_does_not_allocate(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", random_gaussians(2))
    data = (tmp_path / "a.ply").read_bytes().replace(b"element vertex 2", b"element vertex 999999999999")
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(PlyError, match=r"expected 999999999999 vertices, got 2 .*cut off"):
        read_ply(tmp_path / "a.ply")


GOOD = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ply\n", "plx\n", "does not begin with 'ply'"),
        ("format ascii 1.0\n", "", "end_header"),
        ("ascii 1.0", "ascii 2.0", "ascii 2.0"),
        ("vertex 1", "vertex -1", "vertex -1"),
        ("vertex 1", "point 1", "element 'vertex'"),
        ("float x", "quad x", "quad x"),
        ("float x", "list uchar int x", "number properties"),
        ("property float x\n", "", "number properties"),
        ("float x\n", "float x\nproperty float x\n", "'x' twice"),
        ("end_header\n1\n", "", "cut off"),
        ("end_header\n1\n", "end_header\nabc\n", "expected numbers"),
        ("end_header\n1\n", "end_header\n1 2\n", "expected 1 numbers, got 2"),
        ("", "", "without y, z, f_dc_0.*not as a mesh or point cloud"),
    ],
)
def test_malformed_files_say_what_is_wrong(tmp_path: Path, old: str, new: str, words: str) -> None:
    (tmp_path / "a.ply").write_text(GOOD.replace(old, new, 1) if old else GOOD)
    with pytest.raises(PlyError, match=words):
        read_ply(tmp_path / "a.ply")


def test_incomplete_harmonics_are_refused(tmp_path: Path) -> None:
    _, names, rows = shuffled(tmp_path)
    write_text(tmp_path / "a.ply", [name.replace("stranger", "f_rest_0") for name in names], rows)
    with pytest.raises(PlyError, match="got 1 f_rest properties"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["x", "opacity", "scale_1"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_broken_values_are_counted_when_read(tmp_path: Path, name: str, value: float) -> None:
    _, names, rows = shuffled(tmp_path)
    rows[2:4, names.index(name)] = value
    write_text(tmp_path / "a.ply", names, rows)
    with pytest.raises(PlyError, match="got 2 broken Gaussians"):
        read_ply(tmp_path / "a.ply")


def changed(**fields: torch.Tensor) -> Gaussians:
    good = random_gaussians(3)
    values = {name: getattr(good, name) for name in ("means", "quats", "scales", "opacities", "colors")}
    return Gaussians(**{**values, **fields})


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"means": torch.tensor([[0.0, 0, 0], [float("nan"), 0, 0], [0, 0, 0]])}, "finite means, got 1 rows"),
        ({"scales": torch.full((3, 3), -1.0)}, "scales >= 0"),
        ({"opacities": torch.full((3,), 1.5)}, r"opacities in \[0,1\]"),
        ({"colors": torch.full((3, 3), float("inf"))}, "finite colors, got 3 rows"),
    ],
)
def test_gaussians_that_no_viewer_could_show_are_not_written(
    tmp_path: Path, fields: dict[str, torch.Tensor], words: str
) -> None:
    with pytest.raises(PlyError, match=words):
        write_ply(tmp_path / "a.ply", changed(**fields))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["x", "f_rest_0", "two words", "größe", ""])
def test_property_names_that_would_break_the_header_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(PlyError, match="unused ASCII identifier"):
        write_ply(tmp_path / "a.ply", random_gaussians(3), {name: torch.zeros(3)})


@pytest.mark.parametrize("comment", ["two\nlines", "end_header\n", "ü", "x" * 5000])
def test_comments_that_would_break_the_header_are_refused(tmp_path: Path, comment: str) -> None:
    with pytest.raises(PlyError, match="one printable ASCII line"):
        write_ply(tmp_path / "a.ply", random_gaussians(3), comments=[comment])


def test_extra_of_another_length_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PlyError, match=r"expected observed of shape \[3\], got \[4\]"):
        write_ply(tmp_path / "a.ply", random_gaussians(3), {"observed": torch.zeros(4)})


def test_missing_file_is_a_file_not_found_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_ply(tmp_path / "none.ply")
