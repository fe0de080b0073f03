"""`ahoy cost`: what accuracy costs in time, swept on captures whose truth is known."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from flows.bad_input import bad_input_said

if TYPE_CHECKING:
    from tasks.cost.rows import Rows
    from tasks.stage import Observer

console = Console()
MACHINE, PAGE = "machine.json", "cost.md"


def cost(
    stages: Annotated[
        list[str] | None, typer.Argument(help="perceive, texture, coarse, avatar, end-to-end  [default: all]")
    ] = None,
    out: Annotated[Path, typer.Option(help="folder for the rows, the diagrams and the page")] = Path("out/cost"),
    dataset: Annotated[
        str | None, typer.Option(help="folder of captures; without it the page is made of the rows in OUT")
    ] = None,
    only: Annotated[str | None, typer.Option(help="captures by name, comma-separated")] = None,
    preset: Annotated[str, typer.Option(help="base settings that knobs are changed around")] = "draft",
    presets: Annotated[str, typer.Option(help="presets to run end to end, comma-separated")] = "draft,standard,high",
    knob: Annotated[
        list[str] | None, typer.Option(help="only this, with other values: STAGE.KNOB=A,B,...; repeatable")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="runs of every setting")] = 3,
    size: Annotated[int, typer.Option(min=32, help="longest side of what is compared end to end, pixels")] = 256,
    threads: Annotated[int, typer.Option(min=1, help="of every computation: more make CPU seconds dearer")] = 1,
    store: Annotated[str | None, typer.Option(help="URL of the artifact store  [default: OUT/store]")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="a base setting, as STAGE.KNOB=VALUE")] = None,
    page: Annotated[Path | None, typer.Option(help="the page; diagrams go beside it  [default: OUT/cost.md]")] = None,
    measured: Annotated[Path | None, typer.Option(help="also write the set that `ahoy run --budget` reads")] = None,
) -> None:
    """Sweep the knobs of stages and whole runs; rows that are there are not measured again."""
    import torch

    from flows.terminal import TerminalObserver
    from tasks.cost.declared import END_TO_END
    from tasks.cost.rows import Rows

    with bad_input_said(console):
        torch.set_num_threads(threads)
        rows = Rows(out)
        if dataset is not None:
            wanted = _wanted(stages or [], knob or [], [name for name in presets.split(",") if name], preset)
            fields: dict[str, Any] = {
                "dataset": dataset,
                "out": str(out),
                "store": store,
                "preset": preset,
                "size": size,
            }
            fields |= {"only": tuple(only.split(",")) if only else (), "overrides": tuple(set_ or ())}
            around = _note_machine(out / MACHINE, preset, set_ or [], whole_runs_alone=set(wanted) == {END_TO_END})
            with TerminalObserver(console) as observer:
                _measure(fields, wanted, around, repeats, rows, observer)
        for path in _write(rows, out, page or out / PAGE, measured):
            console.print(str(path), soft_wrap=True, highlight=False)


def _wanted(
    stages: Sequence[str], knobs: Sequence[str], presets: Sequence[str], preset: str
) -> dict[str, dict[str, Sequence[Any]]]:
    """What was swept -> knob -> values."""
    from tasks.cost.declared import END_TO_END, END_TO_END_KNOBS, STAGE_SWEEPS

    declared: dict[str, dict[str, Sequence[Any]]] = {name: dict(one.knobs) for name, one in STAGE_SWEEPS.items()}
    round_it = next((knobs_of for name, knobs_of in END_TO_END_KNOBS.items() if name == preset), {})
    declared[END_TO_END] = {"preset": presets, **round_it}
    if unknown := sorted(set(stages) - set(declared)):
        raise ValueError(f"expected stages among {', '.join(declared)}, got {', '.join(unknown)}")
    chosen = {name: knobs_of for name, knobs_of in declared.items() if not stages or name in stages}
    if not knobs:
        return chosen
    narrowed: dict[str, dict[str, Sequence[Any]]] = {}
    for text in knobs:
        name, equals, values = text.partition("=")
        stage = name.partition(".")[0]
        homes = [home for home in chosen if home == stage or (home == END_TO_END and stages)]
        if not equals or "." not in name or not homes:
            raise ValueError(f"expected STAGE.KNOB=A,B,... of {', '.join(chosen)}, got {text!r}")
        for home in homes:
            key = name if home == END_TO_END else name.partition(".")[2]
            narrowed.setdefault(home, {})[key] = [_value(one) for one in values.split(",")]
    if END_TO_END in narrowed:
        narrowed[END_TO_END] = {"preset": presets, **narrowed[END_TO_END]}
    return narrowed


def _measure(
    fields: Mapping[str, Any],
    wanted: Mapping[str, Mapping[str, Sequence[Any]]],
    around: str,
    repeats: int,
    rows: Rows,
    observer: Observer,
) -> None:
    from flows.cost import Base, stage_rows, whole_rows
    from flows.evaluate_request import EvaluateRequest
    from tasks.cost.declared import END_TO_END, STAGE_SWEEPS

    def told(line: str) -> None:
        console.print(escape(line), highlight=False, soft_wrap=True)

    request = EvaluateRequest.model_validate({**fields, "ablate": ("full",)})
    artifacts = request.open_store()
    for capture in request.captures():
        base = Base(request, capture, artifacts, observer)
        for name, values in wanted.items():
            if name == END_TO_END:
                whole_rows(base, _requests(request, values, around), around, repeats, rows, told)
            else:
                stage_rows(base, STAGE_SWEEPS[name], values, repeats, rows, told)


def _requests(request: Any, values: Mapping[str, Sequence[Any]], around: str) -> list[tuple[Any, Any]]:
    """Every preset and every single change of the base, each with the request that it stands for."""
    from tasks.cost.change import PRESET, Change

    found = []
    for knob, choices in values.items():
        for value in choices:
            if knob == PRESET:
                found.append((Change(around, PRESET, value), request.model_copy(update={"preset": value})))
                continue
            text = f"{knob}={value if isinstance(value, str) else json.dumps(value)}"  # false, not False
            changed = request.model_copy(update={"overrides": (*request.overrides, text)})
            found.append((Change(request.preset, knob, value), changed))
    return found


def _note_machine(path: Path, preset: str, overrides: Sequence[str], whole_runs_alone: bool) -> str:
    """Say what the rows are measured on; the fastest unit of several calls counts.

    Returns:
        The preset that the rows of this folder are round unless they name another: that of the first sweep.

    Raises:
        ValueError: rows of one folder would not be round the same settings, and not say so.
    """
    from ahoy_core.cost.machine import machine
    from ahoy_core.cost.pace import measure_pace

    before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    unit = min(measure_pace().cpu_s, before.get("unit_cpu_s", float("inf")))
    base = before.get("base", {"preset": preset, "overrides": list(overrides)})
    if list(overrides) != base["overrides"] or (preset != base["preset"] and not whole_runs_alone):
        raise ValueError(
            f"expected sweeps round preset {base['preset']} with {base['overrides'] or 'no overrides'}, as the rows in "
            f"{path.parent} are (end-to-end alone may be round another preset), got {preset} with {list(overrides)}; "
            "take another --out"
        )
    path.write_text(json.dumps({"machine": machine(), "unit_cpu_s": unit, "base": base}, indent=1), encoding="utf-8")
    return str(base["preset"])


def _write(rows: Rows, out: Path, page: Path, measured: Path | None) -> list[Path]:
    from tasks.cost.measured import write_measured
    from tasks.cost.page import write_page
    from tasks.cost.rows import TABLE, write_table

    if not rows.rows or not (out / MACHINE).is_file():
        raise ValueError(f"expected rows in {out}, got none; name captures with --dataset to measure some")
    facts = json.loads((out / MACHINE).read_text(encoding="utf-8"))
    where = facts["machine"]
    said = {
        "preset": facts["base"]["preset"],
        "base": f"preset {facts['base']['preset']}" + "".join(f", {one}" for one in facts["base"]["overrides"]),
        "machine": f"{where['cpu']}, {where['cores']} cores, {where['memory_gb']} GB, torch "
        f"{where['packages']['torch']}, one thread",
    }
    write_table(out / TABLE, rows.rows)
    written = [out / TABLE, *write_page(rows.rows, said, page)]
    if measured is not None:
        write_measured(measured, rows.rows, facts)
        written.append(measured)
    return written


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text
