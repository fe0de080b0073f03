"""Stage `report`: one self-contained HTML page: pictures, scores, the bill, who did what, what was left out."""

from __future__ import annotations

import base64
from importlib.metadata import version
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, select_autoescape

from storage_schema.store import Manifest
from tasks.roles import packaged
from tasks.stage import NoKnobs, Stage, StageContext, StageOutput

STEPS = {
    "complete": "complete: the prior against the symmetric fill of the texture (3.1)",
    "identity": "identity: fine-tuning of the prior on the subject (3.2)",
    "motions": "motions: planning of sequences from what the video left unseen (3.2)",
    "hallucinate": "hallucinate: coarse renders through the prior and back (3.2)",
}
"""What a stage does, for those that may be skipped."""

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
    "complete": (
        "Prior or symmetric fill",
        "Parts of what the video shows were hidden, and both had to guess them; who came closer completes the texture.",
    ),
    "coarse": ("The coarse avatar", "Loss by step, and observed frames beside the avatar in their pose."),
    "identity": ("The subject in the prior", "The prior before and after it was fine-tuned on this subject's frames."),
    "motions": ("Motions", "Which sequences are worth hallucinating, and why."),
    "hallucinate": ("Hallucinated", "A motion as the coarse avatar renders it, and as the prior repaints it."),
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
    ("complete", "completed.png"): "the canonical body from four sides: by the symmetric fill, and by the prior",
    ("coarse", "compare.png"): "frames of the video beside the whole avatar in the same pose, hidden parts included",
    ("coarse", "losses.png"): "terms of the objective by step, and the score of a frame held out of training",
    ("identity", "before_after.png"): "frames of the video; what the prior draws in their place before, and after",
    ("identity", "losses.png"): "loss of the fine-tuning by step",
    ("hallucinate", "before_after.png"): "above the coarse renders, below the same frames hallucinated",
    ("avatar", "compare.png"): "frames of the video beside the whole avatar in the same pose, hidden parts included",
    ("avatar", "training.png"): "as the training went: what supervises above, the avatar below",
    ("avatar", "faces.png"): "the face views that supervise the head; blue has no weight, tinted less",
    ("avatar", "losses.png"): "terms of the objective by step, and the score of a frame held out of training",
    ("animate", "turntable.png"): "eight views of the avatar",
}


def run_report(config: NoKnobs, ctx: StageContext) -> StageOutput:
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
    # Presets hold this stage's configuration, and the measured set is round a preset.
    from tasks.bill import run_bill
    from tasks.cost.measured import packaged_set

    summaries = {name: manifest.summary for name, manifest in ctx.manifests.items()}
    bill = run_bill(ctx, packaged_set())
    total = sum(row.wall_s for row in bill.rows)
    predicted = [row.predicted_s for row in bill.rows if row.predicted_s is not None]
    filled = [(role, who) for manifest in ctx.manifests.values() for role, who in manifest.roles.items()]
    roles = {(role, who["name"]): {"role": role, **who} for role, who in filled}  # stages may differ in who fills one
    return {
        "version": version("ahoy-avatars"),
        "title": f"Avatar from video {ctx.manifests['ingest'].inputs['source'][:8]}",
        "invented": summaries["coarse"]["invented"],
        "videos": [
            _video(ctx, "turntable.mp4", "turntable"),
            _video(ctx, "motion.mp4", "a motion that the video does not show"),
        ],
        "sections": [
            _section(ctx, title, manifest)
            for name in SECTIONS
            for title, manifest in sorted(ctx.manifests.items())
            if manifest.stage == name
        ],
        "bill": bill,
        "shares": [100 * row.wall_s / max(total, 1e-9) for row in bill.rows],
        "total_wall": total,
        "total_cpu": sum(row.cpu_s for row in bill.rows),
        "total_predicted": sum(predicted) if predicted else None,
        "roles": list(roles.values()),
        "absent": [(STEPS.get(name, name), reason) for name, reason in ctx.skipped.items()],
    }


def _section(ctx: StageContext, title: str, manifest: Manifest) -> dict[str, Any]:
    """A stage's section; `title` is the stage's, with the item of a mapped one."""
    heading, text = SECTIONS[manifest.stage]
    item = title.partition("/")[2].replace("-", " ")
    pictures = [
        {"kind": "png", "caption": CAPTIONS.get((manifest.stage, p), p), "data": _base64(ctx.inputs[title] / p)}
        for p in manifest.summary["pictures"]
    ]
    facts = [(k.replace("_", " "), v) for k, v in manifest.summary.get("facts", {}).items()]
    return {
        "title": f"{heading}: {item}" if item else heading,
        "text": text,
        "pictures": pictures,
        "notes": manifest.summary.get("notes", []),
        "facts": facts,
    }


def _video(ctx: StageContext, name: str, caption: str) -> dict[str, str]:
    return {"caption": caption, "data": _base64(ctx.inputs["animate"] / name)}


def _base64(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()


REPORT = Stage(
    "report",
    5,
    NoKnobs,
    ("ingest", "perceive", "texture", "coarse", "avatar", "animate"),
    run_report,
    # The bill is predicted from it.
    lambda config: {"measured set": packaged("cost.json")},
    wants=("complete", "identity", "motions", "hallucinate"),
    explains=True,
)
