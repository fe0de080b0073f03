"""`ahoy export`: an avatar as files that other programs open."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, cast

import typer
from rich.console import Console
from rich.markup import escape

EXIT_BAD_INPUT = 2
_FORMATS = ("ply", "spz", "glb", "npz", "frames")


def export(
    avatar: Annotated[Path, typer.Argument(help="folder of an avatar, as `ahoy run` leaves it")],
    out: Annotated[Path, typer.Option(help="the file; a folder for frames")],
    format_: Annotated[str, typer.Option("--format", help=", ".join(_FORMATS))] = "ply",
    motion: Annotated[str | None, typer.Option(help="built-in motion or file, for frames or --frame")] = None,
    frame: Annotated[int | None, typer.Option(help="which frame of the motion; the canonical pose without")] = None,
    fps: Annotated[float, typer.Option(help="frames a second of the motion")] = 24.0,
    axes: Annotated[str | None, typer.Option(help="z-up, y-up or y-down; by default the format's own")] = None,
) -> None:
    """Write an avatar as .ply, .spz, .glb, skinned .npz, or one .ply a frame, with its label in the metadata."""
    console = Console()
    try:
        count = _export(avatar, out, format_, motion, frame, fps, axes)
    except (ValueError, OSError) as error:
        console.print("[red]error:[/]", escape(str(error)), highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_BAD_INPUT) from None
    console.print(f"{out} ({count})", soft_wrap=True, highlight=False)


def _export(
    folder: Path, out: Path, kind: str, name: str | None, frame: int | None, fps: float, axes: str | None
) -> str:
    from ahoy_core.avatar.files import load_avatar
    from ahoy_core.body.packaged import load_packaged_body
    from ahoy_core.export import Axes, export_frames, export_rig, export_splats
    from ahoy_core.motion import load_motion

    if kind not in _FORMATS:
        raise ValueError(f"expected --format among {', '.join(_FORMATS)}, got {kind!r}")
    if axes not in (None, "z-up", "y-up", "y-down"):
        raise ValueError(f"expected --axes z-up, y-up or y-down, got {axes!r}")
    made, body = load_avatar(folder), load_packaged_body()
    turn = cast(Axes | None, axes)
    out.parent.mkdir(parents=True, exist_ok=True)
    if kind == "npz":
        export_rig(made, body, out)
        return f"{len(made)} skinned Gaussians"
    if kind == "frames":
        clip = load_motion(name or "turn", body, made.betas, fps)
        return f"{len(export_frames(made, body, clip, out, axes=turn))} files"
    posed = None
    if frame is not None:
        clip = load_motion(name or "turn", body, made.betas, fps)
        if not 0 <= frame < len(clip):
            raise ValueError(f"expected --frame in 0..{len(clip) - 1}, got {frame}")
        posed = made.pose(body, clip.pose[frame], clip.transl[frame])
    export_splats(made, out, cast(Literal["ply", "spz", "glb"], kind), posed, turn)
    return f"{len(made)} Gaussians"
