"""`ahoy render`: avatars, motions and a scene to a video, with the effects that the scene calls for."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from flows.bad_input import bad_input_said


def render(
    avatars: Annotated[
        list[str], typer.Argument(help="folders of avatars (what `ahoy run` leaves); several for a group")
    ],
    out: Annotated[Path, typer.Option(help="the video (.mp4), or a folder for PNG frames")],
    motion: Annotated[
        list[str] | None, typer.Option(help="turn, wave, walk, sit, still, or a .npz or .bvh; one an avatar")
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option(help="X,Y,HEADING: where an avatar starts (metres, degrees); one an avatar")
    ] = None,
    scene: Annotated[str | None, typer.Option(help="a .ply, .spz or .glb of Gaussians, or `room`")] = None,
    scene_cameras: Annotated[str | None, typer.Option(help="COLMAP folder or transforms.json of the scene")] = None,
    scene_up: Annotated[str | None, typer.Option(help="axis that is up in the scene's file, such as -y or z")] = None,
    scene_scale: Annotated[float | None, typer.Option(help="metres a unit of the scene's file")] = None,
    camera: Annotated[str, typer.Option(help="auto, orbit, X,Y,Z/X,Y,Z (eye and target), or FILE#IMAGE")] = "auto",
    effects: Annotated[str, typer.Option(help="auto, all, none, or names with commas between")] = "auto",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels")] = "512x512",
    fps: Annotated[float, typer.Option(help="frames a second")] = 24.0,
    frames: Annotated[int | None, typer.Option(help="at most this many")] = None,
    shutter: Annotated[float, typer.Option(help="share of a frame that the shutter is open")] = 0.5,
    aperture: Annotated[float, typer.Option(help="diameter of the lens in metres; 0 is a pinhole")] = 0.0,
    focus: Annotated[float, typer.Option(help="metres to what is sharp; 0 for the first avatar")] = 0.0,
    background: Annotated[float, typer.Option(help="grey behind everything, 0 to 1")] = 0.5,
    pca: Annotated[float, typer.Option(help="0 to 1: pull poses towards those of the training")] = 0.0,
    light: Annotated[float | None, typer.Option(help="0 to 1: strength of the light match")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="show the numbers behind each decision")] = False,
    plan_only: Annotated[bool, typer.Option("--plan", help="print the plan and stop")] = False,
    workers: Annotated[int, typer.Option(help="frames rendered at a time")] = 2,
    keep_frames: Annotated[bool, typer.Option("--keep-frames", help="keep the PNGs beside the video")] = False,
) -> None:
    """Render avatars in a scene; what is called for is worked out first and printed with its estimated cost."""
    from tasks.render import RenderRequest, prepare, render_clip

    console = Console()
    with bad_input_said(console, MemoryError):
        width, height = _size(size)
        request = RenderRequest.model_validate(
            {
                "avatars": tuple(avatars),
                "motions": tuple(motion or ["turn"]),
                "places": tuple(_place(text) for text in at or ["0,0,0"]),
                "scene": scene,
                "scene_cameras": scene_cameras,
                "scene_up": scene_up,
                "scene_scale": scene_scale,
                "camera": camera,
                "effects": effects,
                "width": width,
                "height": height,
                "fps": fps,
                "frames": frames,
                "shutter": shutter,
                "aperture": aperture,
                "focus": focus,
                "background": background,
                "pca": pca,
                "strengths": {} if light is None else {"light": light},
            }
        )
        job = prepare(request)
        _show_plan(console, job.plan, job.notes, explain)
        if plan_only:
            return
        with _bar(console) as show:
            record = render_clip(job, out, workers=workers, progress=show, keep_frames=keep_frames)
    _show_costs(console, record)
    if request.pca:
        _plot_pull(record, out)
    console.print(f"{'video' if out.suffix == '.mp4' else 'frames':<8} {out}", soft_wrap=True, highlight=False)


def _size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() for part in parts):
        raise ValueError(f"expected --size as WIDTHxHEIGHT, got {text!r}")
    return int(parts[0]), int(parts[1])


def _place(text: str) -> tuple[float, float, float]:
    try:
        x, y, heading = (float(part) for part in (text + ",0" if text.count(",") == 1 else text).split(","))
    except ValueError:
        raise ValueError(f"expected --at as X,Y or X,Y,HEADING, got {text!r}") from None
    return x, y, heading


def _show_plan(console: Console, plan: Any, notes: tuple[str, ...], explain: bool) -> None:
    for note in notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)
    table = Table("effect", "", "why", "estimated CPU s", title=f"plan for {plan.frames} frames")
    for effect in plan.effects:
        why = effect.reason
        if explain and effect.evidence:
            why += "\n" + ", ".join(f"{name} = {value:g}" for name, value in effect.evidence.items())
        cost = f"{effect.seconds:.2f}" if effect.on else "0" if not effect.seconds else f"saves {effect.seconds:.2f}"
        table.add_row(effect.name, "[green]on[/]" if effect.on else "off", escape(why), cost)
    table.add_row("everything else", "", "posing, drawing, storing", f"{plan.base_seconds:.2f}")
    table.add_row("all", "", "", f"{plan.seconds:.2f}")
    console.print(table)


def _show_costs(console: Console, record: dict[str, Any]) -> None:
    if not record["rendered"]:
        console.print("every frame was there already")
        return
    share = record["rendered"] / record["frames"]
    table = Table("effect", "estimated CPU s", "measured", title=f"{record['rendered']} frames rendered")
    for effect in record["effects"]:
        if effect["on"]:
            table.add_row(effect["name"], f"{share * effect['seconds']:.2f}", f"{effect['measured_seconds']:.2f}")
    base = record["base"]
    table.add_row("everything else", f"{share * base['seconds']:.2f}", f"{base['measured_seconds']:.2f}")
    table.add_row("all", f"{record['estimated_seconds']:.2f}", f"{record['measured_seconds']:.2f}")
    console.print(table)


@contextmanager
def _bar(console: Console) -> Iterator[Callable[[int, int], None]]:
    columns = (TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("frames", total=None)
        yield lambda done, total: bars.update(bar, completed=done, total=total)


def _plot_pull(record: dict[str, Any], out: Path) -> None:
    """How far every frame's pose was pulled towards the training poses, as a plot beside the video."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    for number, pull in enumerate(record["pull_radians"]):
        axes.plot([math.degrees(angle) for angle in pull], label=f"avatar {number}")
    axes.set(xlabel="frame", ylabel="mean angle over the joints, degrees", title="pulled towards the training poses")
    axes.legend()
    figure.savefig(out.with_name(out.name + ".pull.png"), dpi=110)
