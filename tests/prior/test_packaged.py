"""The prior that ships: what a fresh clone may rely on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from ahoy_core.conventions import GREY
from ahoy_core.formats.images import read_png
from ahoy_core.prior.bodymaps import CELL
from ahoy_core.prior.corpus.prompts import NEUTRAL
from ahoy_core.prior.framing import HEIGHT, WIDTH
from ahoy_core.prior.video import EmbeddedVideo, load_video
from ahoy_core.prior.words import bare_context, drawn_from_words
from flows.prior_cli import app
from tasks.fills import Fills
from tasks.prior_folder import no_prior, prior_folder

FOLDER = prior_folder("packaged")
MEGABYTES = 40


@pytest.fixture(scope="module")
def video() -> EmbeddedVideo:
    loaded = load_video(FOLDER)
    assert isinstance(loaded, EmbeddedVideo)
    return loaded


def test_it_is_there_small_enough_and_has_a_card() -> None:
    assert no_prior("packaged", "packaged", Fills()) == ""
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < MEGABYTES * 2**20
    card = (FOLDER / "README.md").read_text()
    for expected in ("Licence", "Data", "Splits", "Seeds", "Limits", "Figures"):
        assert expected in card, expected
    assert (FOLDER / "curves.png").is_file()


def test_its_files_name_no_place_of_the_machine_that_made_it() -> None:
    for path in FOLDER.rglob("*.json"):
        assert "_name_or_path" not in path.read_text() and "/tmp" not in path.read_text(), path


def test_it_is_trained(video: EmbeddedVideo) -> None:
    """From noise and a bare body alone it draws somebody where the body is, and grey round them."""
    maps, _ = bare_context(video.size)
    away = (drawn_from_words(video, [NEUTRAL])[0] - GREY).square().mean(1).sqrt()
    silhouette = maps[0, :, :1].repeat_interleave(CELL, -1).repeat_interleave(CELL, -2)[:, 0]
    near = torch.nn.functional.max_pool2d(silhouette[:, None], 17, 1, 8)[:, 0]
    inside, outside = away[silhouette > 0.9].mean(), away[near < 0.01].mean()
    assert float(outside) < 0.05 and float(inside) > 3 * float(outside), (float(inside), float(outside))


def test_it_hears_words(video: EmbeddedVideo) -> None:
    """Whose top and trousers are named red and blue has them so, and the reverse."""
    maps, _ = bare_context(video.size)
    height, inside = maps[0, :, 3], maps[0, :, 0] > 0.9
    bands = (inside & (height > 0.15) & (height < 0.5), inside & (height > -0.7) & (height < -0.15))
    prompts = ("a person, red top, blue trousers", "a person, blue top, red trousers")
    redness = []
    for views in drawn_from_words(video, prompts):
        cells = torch.nn.functional.avg_pool2d(views, CELL)
        redness.append(torch.stack([(cells[:, 0] - cells[:, 2])[band].mean() for band in bands]))
    difference = (redness[0] - redness[1]) * torch.tensor([1, -1])
    assert float(difference.min()) > 0.3, redness  # colours named differ by .6 or more


def test_a_sheet_of_words_is_drawn_by_a_command(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["draw", "a person", "a person, red top", "--out", str(tmp_path / "words.png")])
    assert result.exit_code == 0, result.output
    height, width = read_png(tmp_path / "words.png").shape[:2]
    assert width >= 2 * 2 * 4 * WIDTH and height >= 2 * HEIGHT


def test_a_prior_that_reads_no_bodies_is_not_asked_for_four_views(wan_folders: dict[str, Path]) -> None:
    with pytest.raises(ValueError, match="reads bodies"):
        drawn_from_words(load_video(wan_folders["5b"]), [NEUTRAL])


def test_it_is_part_of_the_package() -> None:
    text = (Path(__file__).resolve().parents[2] / "pyproject.toml").read_text()
    assert '"prior/*"' in text and '"prior/*/*"' in text
