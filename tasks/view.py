"""An avatar in the browser: orbit, motions, expressions, what was observed, and where each part came from."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ahoy_core.avatar.avatar import Avatar, Posed
from ahoy_core.avatar.files import DESCRIPTION, load_avatar
from ahoy_core.body.packaged import PackagedBody, load_packaged_body
from ahoy_core.export import facts
from ahoy_core.formats.npz import load_npz
from ahoy_core.motion import BUILT_IN, Motion, load_motion
from ahoy_core.view.explain import MODES, explained_colors, nearest_hit, source_frame

_SHOWN_ACTIONS = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "eyeBlinkLeft", "eyeBlinkRight", "browInnerUp")
_MISSING = "`ahoy view` needs viser, which is not installed; install it with: pip install 'ahoy-avatars[view]'"


@dataclass(frozen=True)
class Viewed:
    """What was found to show.

    Attributes:
        avatars: By name, the best one last; before the avatar of a run, the coarse one that it was made from.
        frames: [T,H,W,3] of the source, or None where they are not kept.
        source: [A,A] frame of each texel, or None.
    """

    avatars: dict[str, Avatar]
    frames: NDArray[np.uint8] | None = None
    source: NDArray[np.int32] | None = None


def find(path: Path) -> Viewed:
    """Avatars of a folder that `ahoy run` delivered (or of an avatar alone), with the run's frames if they are near.

    Raises:
        FileNotFoundError: No avatar there.
    """
    if (path / DESCRIPTION).is_file():
        folders = {path.name: path}
    else:
        found = sorted(path.glob(f"*/{DESCRIPTION}"))
        if not found:
            raise FileNotFoundError(f"expected an avatar ({DESCRIPTION}) in {path} or a folder in it, found none")
        folders = {file.parent.name: file.parent for file in found}
    avatars = {name: load_avatar(folder) for name, folder in folders.items()}
    if len(avatars) == 1 and (coarse := _newest(path, f"artifacts/coarse/*/attempts/*/{DESCRIPTION}")):
        avatars = {"coarse": load_avatar(coarse.parent), **avatars}
    frames, source = _evidence(path)
    return Viewed(avatars, frames, source)


def _newest(path: Path, pattern: str) -> Path | None:
    """The newest of a run's own artifacts, None where there is no store near it."""
    for root in (path / "store", path.parent / "store"):
        if found := sorted(root.glob(pattern), key=lambda file: file.stat().st_mtime):
            return found[-1]
    return None


def _evidence(path: Path) -> tuple[NDArray[np.uint8] | None, NDArray[np.int32] | None]:
    """Frames and the atlas' source frames from the newest artifacts of the run's own store, if it is there."""
    frames, atlas = (_newest(path, f"artifacts/*/*/attempts/*/{name}.npz") for name in ("frames", "atlas"))
    if not frames or not atlas:
        return None, None
    return load_npz(frames, ["frames"])["frames"], load_npz(atlas, ["source_frame"])["source_frame"]


class Viewer:
    """A running server; `close` ends it. What is shown changes by the controls or by the methods of this class."""

    def __init__(self, viewed: Viewed, port: int = 8080, host: str = "127.0.0.1", fps: float = 24.0) -> None:
        """Start serving.

        Args:
            viewed: From `find`.
            port: To listen on.
            host: The loopback alone by default: an avatar is someone's likeness.
            fps: Frames per second of motions.

        Raises:
            ImportError: viser is not installed.
        """
        try:
            import viser
        except ImportError as error:
            raise ImportError(_MISSING) from error
        self.viewed, self.fps = viewed, fps
        self.body: PackagedBody = load_packaged_body()
        self.name = list(viewed.avatars)[-1]
        self.mode, self.motion_name, self.frame = MODES[0], "still", 0
        self.expression = torch.zeros(self.body.n_expressions)
        self._motions: dict[tuple[str, str], Motion] = {}
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self.server: Any = viser.ViserServer(host=host, port=port, label="Ahoy", verbose=False)
        self.server.scene.set_up_direction("+z")
        posed = self.posed()
        self.handle = self.server.scene.add_gaussian_splats("avatar", *self._arrays(posed))
        self.server.scene.add_grid("ground", width=3, height=3, cell_size=0.5)
        self.server.on_client_connect(self._look)
        self._controls()
        self._player = threading.Thread(target=self._play, name="ahoy-view", daemon=True)
        self._player.start()

    @property
    def avatar(self) -> Avatar:
        """The one that is shown."""
        return self.viewed.avatars[self.name]

    def motion(self) -> Motion:
        """The motion that is shown, of the body that is shown."""
        key = (self.name, self.motion_name)
        if key not in self._motions:
            self._motions[key] = load_motion(self.motion_name, self.body, self.avatar.betas, self.fps)
        return self._motions[key]

    def posed(self) -> Posed:
        """What is shown now."""
        motion = self.motion()
        frame = self.frame % len(motion)
        face = self.expression if bool(self.expression.any()) else None
        return self.avatar.pose(self.body, motion.pose[frame], motion.transl[frame], expression=face)

    def refresh(self) -> None:
        """Send the present state to the browsers."""
        with self._lock:
            self.handle.set_gaussians(*self._arrays(self.posed()))

    def pick(self, origin: tuple[float, ...], direction: tuple[float, ...]) -> tuple[str, NDArray[np.uint8] | None]:
        """What is under a click: a sentence, and the frame of the video it came from."""
        posed = self.posed()
        ray = (torch.tensor(v, dtype=torch.float32) for v in (origin, direction))
        number = nearest_hit(posed.means, posed.covars, posed.opacities, *ray)
        if number is None:
            return "Nothing there.", None
        said = f"Gaussian {number}: observed {float(self.avatar.observed[number]):.0%}. "
        if self.viewed.source is None or self.viewed.frames is None:
            return said + "The run's frames are not here: open the folder that `ahoy run` wrote.", None
        frame = source_frame(self.avatar, number, self.viewed.source)
        if frame is None:
            return said + "The video never showed this part: it was invented.", None
        return said + f"It came from frame {frame} of the run.", self.viewed.frames[
            min(frame, len(self.viewed.frames) - 1)
        ]

    def close(self) -> None:
        """End the server."""
        self._stopped.set()
        self._player.join(timeout=5)
        self.server.stop()

    def _arrays(self, posed: Posed) -> tuple[NDArray[np.float32], ...]:
        colors = explained_colors(self.avatar, self.mode)
        parts = (posed.means, posed.covars, colors.clamp(0, 1), posed.opacities[:, None])
        return tuple(np.ascontiguousarray(part.detach().numpy(), np.float32) for part in parts)

    def _look(self, client: Any) -> None:
        client.camera.position, client.camera.look_at = (0.5, -1.7, 1.1), (0.0, 0.0, 0.85)

    def _controls(self) -> None:
        gui = self.server.gui
        says = facts(self.avatar)
        gui.add_markdown(f"**{says['synthetic_media']}** Invented: {says['invented_share']:.0%} of the surface.")
        if len(self.viewed.avatars) > 1:
            self._chooser(gui.add_dropdown("avatar", tuple(self.viewed.avatars), initial_value=self.name), "name")
        self._chooser(gui.add_dropdown("colours", MODES, initial_value=self.mode), "mode")
        self._chooser(gui.add_dropdown("motion", BUILT_IN, initial_value=self.motion_name), "motion_name")
        self.playing = gui.add_checkbox("play", True)
        with gui.add_folder("expression"):
            for action in _SHOWN_ACTIONS:
                if action in self.body.expression_names:
                    self._slider(gui.add_slider(action, 0.0, 1.0, 0.05, 0.0), self.body.expression_names.index(action))
        self.said = gui.add_markdown("Click a part of the avatar to see where it came from.")
        self.picture = gui.add_image(np.full((8, 8, 3), 240, np.uint8), label="source frame")
        self.server.scene.on_click()(self._clicked)

    def _chooser(self, control: Any, attribute: str) -> None:
        def chosen(event: Any) -> None:
            setattr(self, attribute, event.target.value)
            self.refresh()

        control.on_update(chosen)

    def _slider(self, control: Any, number: int) -> None:
        def moved(event: Any) -> None:
            self.expression[number] = event.target.value
            self.refresh()

        control.on_update(moved)

    def _clicked(self, event: Any) -> None:
        said, picture = self.pick(event.ray_origin, event.ray_direction)
        self.said.content = said
        if picture is not None:
            self.picture.image = picture

    def _play(self) -> None:
        while not self._stopped.wait(1 / self.fps):
            if self.playing.value and len(self.motion()) > 1 and self.motion_name != "still":
                self.frame += 1
                self.refresh()


def serve(path: Path, port: int, host: str, say: Callable[[str], None]) -> None:
    """Show what is at a path until interrupted."""
    viewer = Viewer(find(path), port, host)
    say(f"http://{host}:{port}")
    try:
        while True:
            time.sleep(3600)
    finally:
        viewer.close()
