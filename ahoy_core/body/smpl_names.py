"""Joint names of the SMPL family, in the files' order, and their partners on the packaged body."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

_BODY: Final = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
# The files' order of fingers: ring before thumb, little finger third.
_FINGERS: Final = ("index", "middle", "pinky", "ring", "thumb")
_HANDS: Final = tuple(f"{s}_{f}{k}" for s in ("left", "right") for f in _FINGERS for k in (1, 2, 3))

JOINT_NAMES: Final[Mapping[str, tuple[str, ...]]] = {
    "smpl": (*_BODY, "left_hand", "right_hand"),
    "smplh": (*_BODY, *_HANDS),
    "smplx": (*_BODY, "jaw", "left_eye_smplhf", "right_eye_smplhf", *_HANDS),
}

# MakeHuman counts fingers from the thumb; twist bones (upperarm02, ...) and palm bones have no partner.
_FINGER_NUMBER: Final = {"thumb": 1, "index": 2, "middle": 3, "ring": 4, "pinky": 5}
_MIDDLE: Final = {"pelvis": "root", "spine1": "spine05", "spine2": "spine03", "spine3": "spine01", "neck": "neck01",
                  "head": "head", "jaw": "jaw"}  # fmt: skip
_SIDED: Final = {"hip": "upperleg01", "knee": "lowerleg01", "ankle": "foot", "foot": "toe3-1", "collar": "clavicle",
                 "shoulder": "upperarm01", "elbow": "lowerarm01", "wrist": "wrist", "eye_smplhf": "eye"}  # fmt: skip
# The SMPL family's one joint of the toes moves all of the packaged body's.
_TOES: Final = tuple(f"toe{k}-1" for k in range(1, 6))
_TRUNK: Final = {"spine1": "pelvis", "spine2": "spine1", "spine3": "spine2", "neck": "spine3", "head": "neck",
                 "jaw": "head"}  # fmt: skip
_ABOVE: Final = {"hip": "pelvis", "knee": "hip", "ankle": "knee", "foot": "ankle", "collar": "spine3",
                 "shoulder": "collar", "elbow": "shoulder", "wrist": "elbow", "hand": "wrist",
                 "eye_smplhf": "head"}  # fmt: skip
# Rest poses differ in arms and legs alone: everybody's trunk stands upright and everybody's soles are flat, whatever
# the slope of the bones that run through them.
_LIMBS: Final = ("hip", "knee", "shoulder", "elbow", "wrist")


def _finger_pairs() -> dict[str, str]:
    return {f"{f}{k}": f"finger{number}-{k}" for f, number in _FINGER_NUMBER.items() for k in (1, 2, 3)}


def packaged_from_smpl(smpl_names: tuple[str, ...]) -> dict[str, str]:
    """Joints of the packaged body -> joints of an SMPL-family body: the map for poses that go to the packaged body."""
    pairs = {packaged: smpl for smpl, packaged in smpl_from_packaged(smpl_names).items()}
    for letter, side in (("L", "left"), ("R", "right")):
        pairs |= {f"{toe}.{letter}": f"{side}_foot" for toe in _TOES}
    return pairs


def smpl_from_packaged(smpl_names: tuple[str, ...]) -> dict[str, str]:
    """Joints of an SMPL-family body -> joints of the packaged body: the map for poses that come from it.

    SMPL's hand joint, which bends all fingers at once, has no partner and rests.
    """
    pairs = dict(_MIDDLE)
    for letter, side in (("L", "left"), ("R", "right")):
        sided = {**_SIDED, **_finger_pairs()}
        pairs |= {f"{side}_{smpl}": f"{packaged}.{letter}" for smpl, packaged in sided.items()}
    return {smpl: packaged for smpl, packaged in pairs.items() if smpl in smpl_names}


def within_smpl(target_names: tuple[str, ...], source_names: tuple[str, ...]) -> dict[str, str]:
    """Joints of one SMPL-family body -> joints of another: equal names, and SMPL's hand for the first finger joints."""
    pairs = {name: name for name in target_names if name in source_names}
    for side in ("left", "right"):
        if f"{side}_hand" in target_names and f"{side}_middle1" in source_names:
            pairs[f"{side}_hand"] = f"{side}_middle1"
        if f"{side}_hand" in source_names and f"{side}_middle1" in target_names:
            pairs |= {f"{side}_{finger}1": f"{side}_hand" for finger in _FINGERS if finger != "thumb"}
    return pairs


def smpl_parents(names: tuple[str, ...]) -> tuple[int, ...]:
    """Parent of each joint of `JOINT_NAMES`, -1 for the root: the family's tree, which their files hold as well."""
    found = [-1]
    for name in names[1:]:
        side, _, part = name.partition("_")
        above = _TRUNK.get(name) or _ABOVE.get(part)
        if above is None:
            above = "wrist" if part.endswith("1") else f"{part[:-1]}{int(part[-1]) - 1}"
        found.append(names.index(above if above in names else f"{side}_{above}"))
    return tuple(found)


def is_limb(name: str) -> bool:
    """Whether a joint, by its name in either family, belongs to an arm, a hand or a leg (feet left out)."""
    smpl_part = name.partition("_")[2]
    packaged_part = name.partition(".")[0]
    fingers = (*_FINGERS, "hand")
    return (
        smpl_part in _LIMBS
        or smpl_part.rstrip("123") in fingers
        or packaged_part in {_SIDED[limb] for limb in _LIMBS}
        or packaged_part.startswith("finger")
    )
