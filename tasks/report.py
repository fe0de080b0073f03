"""Stage `report`: one self-contained HTML page: pictures, scores, the bill, who did what, what was left out."""

from __future__ import annotations

import base64
from importlib.metadata import version
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, select_autoescape
from pydantic import BaseModel, ConfigDict

from storage_schema.store import Manifest
from tasks.stage import Stage, StageContext, StageOutput

ABSENT = (
    (
        "complete: inpainting of the canonical image, generated side and back views (3.1)",
        "not built yet; the atlas is completed by symmetry and diffusion over the surface instead",
    ),
    ("identity: LoRA fine-tuning of a video model (3.2)", "not built yet"),
    ("hallucinate: RF-inversion of coarse renders (3.2)", "not built yet"),
)

SECTIONS = {
    "ingest": ("The video", "What was read."),
    "perceive": (
        "What was seen",
        "The fitted body, the landmarks and the mask of the visible person, drawn on the input.",
    ),
    "texture": (
        "Texture and coverage",
        "What the video shows of the surface, and what was made up from it.",
    ),
    "coarse": ("The coarse avatar", "Loss by step, and observed frames beside the avatar in their pose."),
    "avatar": (
        "The full avatar",
        "Trained on the video and on sequences from all sides, with corrections of pose, camera and tone.",
    ),
    "animate": ("From every side", "Eight views of the avatar."),
}


CAPTIONS = {
    ("perceive", "overlay.png"): "left of each pair the mask and the landmarks, right the fitted body",
    ("texture", "atlas.png"): "texture of the body's surface: observed (first write wins), coverage, completed",
    ("texture", "canonical.png"): "the canonical pose: observed texels only, and the completed body from four sides",
    ("coarse", "compare.png"): "frames of the video beside the whole avatar in the same pose, hidden parts included",
    ("coarse", "losses.png"): "terms of the objective by step, and the score of a frame held out of training",
    ("avatar", "compare.png"): "frames of the video beside the whole avatar in the same pose, hidden parts included",
    ("avatar", "training.png"): "as the training went: what supervises above, the avatar below",
    ("avatar", "losses.png"): "terms of the objective by step, and the score of a frame held out of training",
    ("animate", "turntable.png"): "eight views of the avatar",
}


class ReportConfig(BaseModel):
    """The report has no knobs; its place in the settings keeps every stage alike."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def run_report(config: ReportConfig, ctx: StageContext) -> StageOutput:
    """Write `report.html`."""
    text = page_environment().get_template("report.html.j2").render(**_content(ctx))
    (ctx.out / "report.html").write_text(text, encoding="utf-8")
    return StageOutput()


def page_environment() -> Environment:
    """The templates, with everything that goes into them escaped: names and messages come from strangers' videos."""
    return Environment(
        loader=PackageLoader("tasks"), autoescape=select_autoescape(default=True, default_for_string=True)
    )


def _content(ctx: StageContext) -> dict[str, Any]:
    summaries = {name: manifest.summary for name, manifest in ctx.manifests.items()}
    bills = [{"stage": name, **summary["bill"]} for name, summary in summaries.items()]
    total = sum(bill["wall_s"] for bill in bills)
    roles = {role: {"role": role, **who} for manifest in ctx.manifests.values() for role, who in manifest.roles.items()}
    return {
        "version": version("ahoy-avatars"),
        "title": f"Avatar from video {ctx.manifests['ingest'].inputs['source'][:8]}",
        "invented": summaries["coarse"]["invented"],
        "videos": [
            _video(ctx, "turntable.mp4", "turntable"),
            _video(ctx, "motion.mp4", "a motion that the video does not show"),
        ],
        "sections": [_section(ctx, name, ctx.manifests[name]) for name in SECTIONS],
        "bills": [{**bill, "share": 100 * bill["wall_s"] / max(total, 1e-9)} for bill in bills],
        "total_wall": total,
        "total_cpu": sum(bill["cpu_s"] for bill in bills),
        "roles": list(roles.values()),
        "absent": list(ABSENT),
    }


def _section(ctx: StageContext, name: str, manifest: Manifest) -> dict[str, Any]:
    title, text = SECTIONS[name]
    pictures = [
        {"kind": "png", "caption": p, "data": _base64(ctx.inputs[name] / p)} for p in manifest.summary["pictures"]
    ]
    facts = [(k.replace("_", " "), v) for k, v in manifest.summary.get("facts", {}).items()]
    return {
        "title": title,
        "text": text,
        "pictures": pictures,
        "notes": manifest.summary.get("notes", []),
        "facts": facts,
    }


def _video(ctx: StageContext, name: str, caption: str) -> dict[str, str]:
    return {"caption": caption, "data": _base64(ctx.inputs["animate"] / name)}


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


REPORT = Stage("report", 2, ReportConfig, ("ingest", "perceive", "texture", "coarse", "avatar", "animate"), run_report)
