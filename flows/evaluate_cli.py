"""`ahoy evaluate`: scores on captures whose truth is known, and the tables of the ablation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from flows.bad_input import bad_input_said

EXIT_SOME_FAILED = 1


def evaluate(
    dataset: Annotated[str, typer.Argument(help="folder of captures (ours, BEHAVE, multi-view), or of videos")],
    out: Annotated[Path, typer.Option(help="folder for metrics.parquet, table.md, pictures and the chart")],
    preset: Annotated[str, typer.Option(help="draft, standard or high")] = "standard",
    ablate: Annotated[str, typer.Option(help="configurations, comma-separated")] = "full,A,B1,B2,C1,C2,C,C3,D",
    only: Annotated[str | None, typer.Option(help="captures by name, comma-separated")] = None,
    protocols: Annotated[str | None, typer.Option(help="protocols by name, comma-separated  [default: all]")] = None,
    kind: Annotated[str, typer.Option(help="auto, ours, behave, multiview or videos")] = "auto",
    size: Annotated[int, typer.Option(help="longest side of what is compared, pixels")] = 256,
    input_camera: Annotated[str, typer.Option(help="camera that made the input, where that is open")] = "",
    truth_body: Annotated[str | None, typer.Option(help="body file that true SMPL parameters belong to")] = None,
    camera: Annotated[bool, typer.Option(help="tell the method the input's camera")] = True,
    renders: Annotated[
        list[str] | None, typer.Option(help="another system's renders, NAME=FOLDER[@INPUT_SETTING]; repeatable")
    ] = None,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="score the textured body mesh and its mirrored completion too")
    ] = False,
    export_baseline_inputs: Annotated[
        Path | None, typer.Option(help="write what other systems are given into this folder, a folder a capture")
    ] = None,
    beside: Annotated[
        list[str] | None, typer.Option("--with", help="metrics.parquet of another evaluation, for the same tables")
    ] = None,
    withhold: Annotated[int, typer.Option(help="of a plain video, every n-th frame is withheld")] = 8,
    store: Annotated[str | None, typer.Option(help="URL of the artifact store  [default: OUT/store]")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="a knob, as STAGE.KNOB=VALUE; repeatable")] = None,
    roles: Annotated[
        Path | None, typer.Option(help="roles.yaml: which model fills each role  [default: AHOY_ROLES]")
    ] = None,
    role: Annotated[
        list[str] | None, typer.Option("--role", help="one role, as ROLE=FILL:PATH or ROLE=embedded; repeatable")
    ] = None,
    trust_code: Annotated[
        bool, typer.Option("--trust-code", help="TorchScript files that --role names are programs and may be run")
    ] = False,
    prefect: Annotated[bool, typer.Option("--prefect", help="as a Prefect flow, watched at PREFECT_API_URL")] = False,
) -> None:
    """Score avatars against the truth; finished cells are found in the store and not made again."""
    from flows import models_cli
    from flows.evaluate import evaluate as run_evaluation
    from flows.evaluate import evaluate_flow
    from flows.evaluate_request import EvaluateRequest
    from flows.terminal import TerminalObserver
    from tasks.evaluation.baselines import BASELINES
    from tasks.evaluation.results import remarks

    console = Console()
    fields = {
        "dataset": dataset,
        "out": str(out),
        "store": store,
        "preset": preset,
        "kind": kind,
        "size": size,
        "input_camera": input_camera,
        "truth_body": truth_body,
        "give_camera": camera,
        "withhold": withhold,
        "ablate": _names(ablate),
        "only": _names(only),
        "overrides": tuple(set_ or ()),
        "baselines": tuple(BASELINES) if baselines else (),
        "export_inputs": str(export_baseline_inputs) if export_baseline_inputs else None,
        "renders": tuple(renders or ()),
        "beside": tuple(beside or ()),
        **({"protocols": _names(protocols)} if protocols else {}),
    }
    with bad_input_said(console):
        models_cli.choose_roles(roles, role or [], trust_code)
        request = EvaluateRequest.model_validate(fields)
        if prefect:
            paths = {name: Path(path) for name, path in evaluate_flow(request).items()}
            failed = False
        else:
            with TerminalObserver(console) as observer:
                paths, cells = run_evaluation(
                    request, observer, told=lambda line: console.print(escape(line), highlight=False, soft_wrap=True)
                )
            for line in remarks(cells):
                console.print(escape(line), highlight=False, soft_wrap=True)
            failed = any(cell.error for cell in cells)
    for name, path in paths.items():
        console.print(f"{name:<20} {path}", soft_wrap=True, highlight=False)
    if failed:
        raise typer.Exit(EXIT_SOME_FAILED)


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip()) if text else ()
