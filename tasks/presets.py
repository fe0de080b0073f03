"""Three ways to spend time, picked from what was measured (docs/cost.md, end to end).

What each costs and scores is its row `preset`, which `ahoy run` cites. `draft` is what knobs are changed around; no
cheaper row is better in both PSNR and ST-LPIPS, though a quarter of its avatar steps or fewer cost little (its row
`avatar.steps=15`). `standard` takes maps of 256, an atlas of 512, larger canonical views and every frame in the
texture: a mean ST-LPIPS of .191 for draft's .203 over four captures, at .14 dB less. The maps do that: alone they have
.190 in nine tenths of its time (row `coarse.map_size=256`). The rest, and what `high` adds (.184, .10 dB less than
standard, for 4.2 times its time), is for pictures larger than the captures' 256 pixels. More steps than draft's bought
nothing in either training. How often landmarks are read and how long the fit is iterated is draft's too: what whole
runs gained by more of it changed its sign with the state of the code (four passes gain .11 to .24 dB on each of the
four captures, and lose .06 over eight others).
"""

from __future__ import annotations

from collections.abc import Mapping

from tasks.settings import Preset, Settings

STANDARD = Settings()

PRESETS: Mapping[Preset, Settings] = {
    "draft": STANDARD.with_overrides(
        (
            "ingest.max_frames=48",
            "ingest.max_size=384",
            "texture.atlas_size=256",
            "texture.frame_stride=2",
            "texture.canonical_height=256",
            "texture.canonical_width=192",
            "coarse.map_size=128",
            "identity.steps=40",
            "motions.limit=2",
            "animate.height=256",
            "animate.width=192",
            "animate.turntable_frames=36",
            "animate.motion_frames=36",
        )
    ),
    "standard": STANDARD,
    "high": STANDARD.with_overrides(
        (
            "ingest.max_size=1024",
            "ingest.max_frames=600",
            "texture.atlas_size=1024",
            "texture.canonical_height=1024",
            "texture.canonical_width=768",
            "coarse.map_size=512",
            "coarse.steps=100",
            "identity.frames=48",
            "motions.limit=5",
            "avatar.steps=160",
            "animate.height=768",
            "animate.width=576",
        )
    ),
}
