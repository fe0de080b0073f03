"""Speed, memory and accuracy-against-time of the CPU rasterizer, beside its peers.

    OMP_WAIT_POLICY=passive python -m benchmarks.raster --json raster.jsonl   # everything; some minutes
    OMP_WAIT_POLICY=passive python -m benchmarks.raster --quick               # the smallest scene only

Writes JSON lines (one measurement a line, the machine in the first) and prints the tables of docs/rasterizer.md.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from ahoy_core.cost import Spread, machine
from benchmarks.peers import PEERS, Peer, PeerUnavailableError, Run, ours
from benchmarks.raster_accuracy import SWEEPS, accuracy_rows
from benchmarks.raster_floor import floor_row
from benchmarks.scenes import SCENES, SceneSpec, make_scene

Row = dict[str, Any]
QUICK_S, QUICK_REPEATS, SLOW_REPEATS = 0.3, 15, 3  # a peer whose forward + backward takes longer than this is slow
OPENSPLAT_RATIO = {
    "10k@256": 11.5,
    "50k@512": 14.6,
    "200k@1024": 29.0,
}  # its CPU path / yardstick; measured apart, not here


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the JSON lines")
    parser.add_argument("--quick", action="store_true", help="the smallest scene, few repeats, no scaling")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.memory_of:
        print(json.dumps(_memory(next(s for s in SCENES if s.name == options.memory_of))))
        return
    rows: list[Row] = [{"kind": "machine", **machine()}]
    for spec in SCENES[:1] if options.quick else SCENES:
        rows += peer_rows(spec, 3 if options.quick else None)
        rows.append({"kind": "floor", "scene": spec.name, **floor_row(make_scene(spec))})
        rows.append(json.loads(_in_fresh_process("--memory-of", spec.name)))
    if not options.quick:
        rows += scaling_rows()
        rows += [{"kind": "accuracy", **row} for sweep in SWEEPS for row in accuracy_rows(sweep)]
    print(tables(rows))
    if options.json:
        options.json.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def peer_rows(spec: SceneSpec, repeats: int | None = None) -> list[Row]:
    """Measure all peers on a scene, forward alone and forward + backward.

    Quick peers take turns with each other, slow ones have their turns afterwards: a peer that sweeps gigabytes through
    the allocator would otherwise be paid for by whoever comes next.
    """
    scene = make_scene(spec)
    rows: list[Row] = []
    quick: list[tuple[Peer, Run]] = []
    slow: list[tuple[Peer, Run]] = []
    for peer in PEERS:
        try:
            run = peer.prepare(scene)
            run(True)  # compiles
            (quick if _timed(run, True)[0] < QUICK_S else slow).append((peer, run))
        except PeerUnavailableError as reason:
            rows.append({"kind": "omission", "scene": spec.name, "peer": peer.name, "why": str(reason)})
    for backward in (False, True):
        times = _in_turns(quick, repeats or QUICK_REPEATS, backward)
        for each in slow:
            times |= _in_turns([each], repeats or SLOW_REPEATS, backward)
        rows += [_peer_row(spec, peer, backward, times) for peer, _ in quick + slow]
    return rows


def _in_turns(peers: list[tuple[Peer, Run]], turns: int, backward: bool) -> dict[str, list[tuple[float, float]]]:
    times: dict[str, list[tuple[float, float]]] = {peer.name: [] for peer, _ in peers}
    for _ in range(turns):
        for peer, run in peers:
            if len(peers) > 1:
                run(backward)  # each is measured warm, not right after the other has swept the caches
            times[peer.name].append(_timed(run, backward))
    return times


def _peer_row(spec: SceneSpec, peer: Peer, backward: bool, times: dict[str, list[tuple[float, float]]]) -> Row:
    mine, base = ([cpu for _, cpu in times[name]] for name in (peer.name, PEERS[0].name))
    paired = len(mine) == len(base)
    ratios = [a / b for a, b in zip(mine, base, strict=True)] if paired else [a / Spread.of(base).median for a in mine]
    return {
        "kind": "speed",
        "scene": spec.name,
        "peer": peer.name,
        "gpu": peer.gpu,
        "pass": "forward+backward" if backward else "forward",
        "cpu_ms": asdict(Spread.of([cpu * 1e3 for cpu in mine])),
        "wall_ms": asdict(Spread.of([wall * 1e3 for wall, _ in times[peer.name]])),
        "cpu_over_ahoy": asdict(Spread.of(ratios)),
    }


def _timed(run: Any, backward: bool) -> tuple[float, float]:
    gc.collect()
    wall, cpu = time.perf_counter(), time.process_time()
    run(backward)
    return time.perf_counter() - wall, time.process_time() - cpu


def scaling_rows() -> list[Row]:
    """Ours alone: against the number of Gaussians, the resolution and the threads."""
    base = SCENES[1]
    many = [replace(base, name=f"{n // 1000}k@512", n=n) for n in (6_250, 12_500, 25_000, 50_000, 100_000, 200_000)]
    large = [replace(base, name=f"50k@{size}", size=size) for size in (128, 256, 512, 1024)]
    rows = [_scaling_row("gaussians", spec, torch.get_num_threads()) for spec in many]
    rows += [_scaling_row("resolution", spec, torch.get_num_threads()) for spec in large]
    doubled = [2**k for k in range((os.cpu_count() or 1).bit_length())]
    return rows + [_scaling_row("threads", spec, threads) for spec in SCENES for threads in doubled]


def _scaling_row(axis: str, spec: SceneSpec, threads: int) -> Row:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        run = ours(make_scene(spec))
        run(True)
        times = [_timed(run, True) for _ in range(5)]
    finally:
        torch.set_num_threads(before)
    wall, cpu = (asdict(Spread.of([t[i] * 1e3 for t in times])) for i in (0, 1))
    return {
        "kind": "scaling",
        "axis": axis,
        "n": spec.n,
        "size": spec.size,
        "threads": threads,
        "wall_ms": wall,
        "cpu_ms": cpu,
    }


def _memory(spec: SceneSpec) -> Row:
    """Peak memory of forward + backward in this fresh process, against the stated bound."""
    from ahoy_core.splat import rasterization

    small = make_scene(replace(spec, n=100, size=32))
    ours(small)(True)  # compile and load before counting
    scene = make_scene(spec)
    inputs = [v for v in vars(scene).values() if isinstance(v, torch.Tensor)]
    input_bytes = sum(v.numel() * v.element_size() for v in inputs if v is not scene.v_render)
    run = ours(scene)
    Path("/proc/self/clear_refs").write_text("5")
    before = _status("VmRSS")
    run(True)
    used = _status("VmHWM") - before
    args = (scene.means, scene.quats, scene.scales, scene.opacities, scene.colors, scene.viewmats, scene.Ks)
    isects = int(rasterization(*args, spec.size, spec.size)[2]["n_isects"])
    image_bytes = spec.size**2 * 4 * 4
    bound = 3 * input_bytes + image_bytes + 16 * isects + 36 * spec.n * torch.get_num_threads()
    return {
        "kind": "memory", "scene": spec.name, "used_mb": used / 2**20, "bound_mb": bound / 2**20,
        "inputs_mb": input_bytes / 2**20, "image_mb": image_bytes / 2**20, "isects": isects,
    }  # fmt: skip


def _status(field: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"expected {field} in /proc/self/status, got none; memory is measured on Linux only")


def _in_fresh_process(*arguments: str) -> str:
    command = [sys.executable, "-m", "benchmarks.raster", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip().splitlines()[-1]


def tables(rows: list[Row]) -> str:
    """The measurements as the markdown tables of the docs."""
    lines = [
        "| scene | rasterizer | forward, CPU ms | forward + backward, CPU ms | range | CPU time / ours |",
        "|---|---|---|---|---|---|",
    ]
    speed = {(r["scene"], r["peer"], r["pass"]): r for r in rows if r["kind"] == "speed"}
    for (scene, peer, name), row in speed.items():
        if name == "forward+backward" and not row["gpu"]:
            ahead, cpu, ratio = speed[scene, peer, "forward"]["cpu_ms"]["median"], row["cpu_ms"], row["cpu_over_ahoy"]
            span = f"{cpu['low']:.1f}-{cpu['high']:.1f}"
            lines.append(f"| {scene} | {peer} | {ahead:.1f} | {cpu['median']:.1f} | {span} | {ratio['median']:.2f} |")
    lines += [f"| {r['scene']} | {r['peer']} | left out: {r['why']} | | | |" for r in rows if r["kind"] == "omission"]
    if any(row["gpu"] for row in speed.values()):
        lines += ["", *_gpu_table(speed)]
    lines += ["", "| scene | pairs blended a pixel | floor, CPU ms | share of the floor reached |", "|---|---|---|---|"]
    for row in (r for r in rows if r["kind"] == "floor"):
        mine = speed[row["scene"], "ahoy", "forward+backward"]["cpu_ms"]["median"]
        pairs, floor = row["blended_per_pixel"], row["floor_ms"]
        lines.append(f"| {row['scene']} | {pairs:.1f} | {floor:.2f} | {floor / mine:.0%} |")
    lines += ["", "| scene | memory used, MB | bound, MB |", "|---|---|---|"]
    lines += [f"| {r['scene']} | {r['used_mb']:.1f} | {r['bound_mb']:.1f} |" for r in rows if r["kind"] == "memory"]
    lines += ["", "| axis | Gaussians | size | threads | wall ms | CPU ms |", "|---|---|---|---|---|---|"]
    for row in (r for r in rows if r["kind"] == "scaling"):
        wall, cpu = row["wall_ms"]["median"], row["cpu_ms"]["median"]
        lines.append(f"| {row['axis']} | {row['n']} | {row['size']} | {row['threads']} | {wall:.1f} | {cpu:.1f} |")
    lines += ["", "| knob | value | image error (rms) | gradient error | CPU ms |", "|---|---|---|---|---|"]
    for row in (r for r in rows if r["kind"] == "accuracy"):
        value = ", ".join(f"{k}={v}" for k, v in row["setting"].items())
        if row["failed"]:
            lines.append(f"| {row['sweep']} | {value} | left out: {row['failed']} | | |")
            continue
        image, gradient = row["errors"]["image_rms"], row["errors"]["gradient"]
        lines.append(
            f"| {row['sweep']} | {value} | {image:.1e} | {gradient:.1e} | {row['cpu_s']['median'] * 1e3:.2f} |"
        )
    return "\n".join(lines)


def _gpu_table(speed: dict[tuple[str, str, str], Row]) -> list[str]:
    """On a GPU the wall clock counts: it and ours on all of the machine's cores, a scene and pass a line."""
    lines = [
        "| scene | pass | on the GPU, wall ms | range | ahoy on the CPU, wall ms | ahoy / GPU |",
        "|---|---|---|---|---|---|",
    ]
    for (scene, _, name), row in speed.items():
        if row["gpu"]:
            there, here = row["wall_ms"], speed[scene, PEERS[0].name, name]["wall_ms"]["median"]
            span, ratio = f"{there['low']:.2f}-{there['high']:.2f}", here / there["median"]
            lines.append(f"| {scene} | {name} | {there['median']:.2f} | {span} | {here:.1f} | {ratio:.1f} |")
    return lines


if __name__ == "__main__":
    main()
