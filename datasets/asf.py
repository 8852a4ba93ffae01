"""Skeletons from the ASF files of Acclaim motion capture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from zoo.datasets.skeleton import ROTATIONS, TRANSLATIONS, Bone, Skeleton, Triple
from zoo.datasets.store import FileFormatError
from zoo.datasets.words import Lines, exactly, numbers, worded_lines

__all__ = ["read_asf"]

INCH = 0.0254
ROOT = "root"


@dataclass(frozen=True, kw_only=True)
class Section:
    """A part of an ASF file that a ``:keyword`` opens, with the words behind it."""

    keyword: str
    line: int
    words: list[str]
    body: Lines


def read_asf(path: str | Path) -> Skeleton:
    """The skeleton of an ASF file: lengths in m, angles in rad.

    CMU's convention: a length l of a file with ``length s`` under ``:units`` is l/s inches, so
    that CMU's s = 0.45 makes one unit 0.0254/0.45 = 0.0564 m. Raises a
    :class:`~zoo.datasets.store.FileFormatError` with file, line and reason.
    """
    found = {s.keyword: s for s in _sections(path)}
    for keyword in ("units", "root", "bonedata", "hierarchy"):
        if keyword not in found:
            raise FileFormatError(path, None, f"section :{keyword} is missing")
    metre, radian = _units(path, found["units"])
    root, position = _root(path, found["root"], metre, radian)
    bones = {ROOT: root}
    for line, block in _blocks(path, found["bonedata"]):
        bone = _bone(path, line, block, metre, radian)
        if bone.name in bones:
            raise FileFormatError(path, line, f"bone {bone.name!r} is defined twice")
        bones[bone.name] = bone
    parents = _hierarchy(path, found["hierarchy"], bones)
    name = found["name"].words[0] if "name" in found and found["name"].words else Path(path).stem
    return Skeleton(
        name=name,
        bones=_ordered(path, bones, parents),
        position=position,
        metre=metre,
    )


def _sections(path: str | Path) -> list[Section]:
    sections: list[Section] = []
    for number, words in worded_lines(path):
        keyword = words[0][1:].lower()
        if words[0].startswith(":"):
            if any(s.keyword == keyword for s in sections):
                raise FileFormatError(path, number, f"section :{keyword} comes twice")
            sections.append(Section(keyword=keyword, line=number, words=words[1:], body=[]))
        elif not sections:
            raise FileFormatError(path, number, f"{words[0]!r} before the first :section")
        else:
            sections[-1].body.append((number, words))
    return sections


def _units(path: str | Path, section: Section) -> tuple[float, float]:
    """Metres and radians of one unit."""
    given = {words[0].lower(): (line, words[1:]) for line, words in section.body}
    line, words = given.get("length", (section.line, ["1.0"]))
    length = exactly(path, line, words, 1, "length")[0]
    if length <= 0:
        raise FileFormatError(path, line, f"length unit must be positive; got {length:g}")
    line, words = given.get("angle", (section.line, ["deg"]))
    if words not in (["deg"], ["rad"]):
        raise FileFormatError(path, line, f"angle unit must be deg or rad; got {' '.join(words)!r}")
    return INCH / length, math.pi / 180 if words == ["deg"] else 1.0


def _root(path: str | Path, section: Section, metre: float, radian: float) -> tuple[Bone, Triple]:
    given = {words[0].lower(): (line, words[1:]) for line, words in section.body}
    for key in ("order", "axis", "position", "orientation"):
        if key not in given:
            raise FileFormatError(path, section.line, f":root has no {key!r}")
    line, order = given["order"]
    dof = tuple(word.lower() for word in order)
    if sorted(dof) != sorted((*TRANSLATIONS, *ROTATIONS)):
        raise FileFormatError(path, line, f"order needs TX TY TZ RX RY RZ; got {' '.join(order)!r}")
    line, axis = given["axis"]
    orientation = _triple(path, *given["orientation"], what="orientation", scale=radian)
    bone = Bone(
        name=ROOT,
        parent=None,
        axis=orientation,
        axis_order=_axis_order(path, line, axis),
        dof=dof,
    )
    return bone, _triple(path, *given["position"], what="position", scale=metre)


def _blocks(path: str | Path, section: Section) -> Iterator[tuple[int, Lines]]:
    """The lines between every ``begin`` and ``end``."""
    start, block = 0, Lines()
    for line, words in section.body:
        if words == ["begin"]:
            if start:
                raise FileFormatError(path, line, f"'begin' inside the block of line {start}")
            start, block = line, []
        elif not start:
            raise FileFormatError(path, line, f"{words[0]!r} outside of begin … end")
        elif words == ["end"]:
            yield start, block
            start = 0
        else:
            block.append((line, words))
    if start:
        raise FileFormatError(path, start, "'begin' without 'end': truncated?")


def _bone(path: str | Path, start: int, block: Lines, metre: float, radian: float) -> Bone:
    given: dict[str, tuple[int, list[str]]] = {}
    limits: Lines = []
    key = ""
    for line, words in block:
        key = "limits" if words[0].startswith("(") and limits else words[0].lower()
        rest = words if words[0].startswith("(") else words[1:]
        if key == "limits":
            limits.append((line, rest))
        given[key] = (line, rest)
    for needed in ("name", "direction", "length", "axis"):
        if needed not in given:
            raise FileFormatError(path, start, f"bone has no {needed!r}")
    dof = tuple(word.lower() for word in given.get("dof", (start, []))[1])
    if any(d not in ROTATIONS for d in dof) or len(set(dof)) != len(dof):
        raise FileFormatError(
            path, given["dof"][0], f"dof must be of rx, ry, rz, once each; got {' '.join(dof)!r}"
        )
    line, axis = given["axis"]
    return Bone(
        name=_name(path, *given["name"]),
        parent=ROOT,
        direction=_direction(path, *given["direction"]),
        length=_length(path, *given["length"]) * metre,
        axis=_triple(path, line, axis[:3], what="axis", scale=radian),
        axis_order=_axis_order(path, line, axis[3:]),
        dof=dof,
        limits=_limits(path, limits, dof, radian),
    )


def _limits(
    path: str | Path, lines: Lines, dof: tuple[str, ...], radian: float
) -> tuple[tuple[float, float], ...]:
    pairs: list[tuple[float, float]] = []
    for line, words in lines:
        bounds = [float(w) * radian for w in _bare(path, line, words)]
        if len(bounds) % 2:
            raise FileFormatError(path, line, "a limit needs two values (low high)")
        pairs += zip(bounds[::2], bounds[1::2], strict=True)
        if any(low > high for low, high in pairs):
            raise FileFormatError(path, line, "the lower limit is above the upper one")
    if lines and len(pairs) != len(dof):
        raise FileFormatError(
            path, lines[0][0], f"{len(dof)} dof need {len(dof)} limits; got {len(pairs)}"
        )
    return tuple(pairs)


def _bare(path: str | Path, line: int, words: list[str]) -> list[str]:
    """Numbers without their brackets; ``inf`` is allowed in a limit."""
    bare = " ".join(words).replace("(", " ").replace(")", " ").split()
    numbers(path, line, [w for w in bare if w.lower().lstrip("+-") not in ("inf", "infinity")])
    return bare


def _hierarchy(path: str | Path, section: Section, bones: dict[str, Bone]) -> dict[str, str]:
    parents: dict[str, str] = {}
    for number, names in (row for _, block in _blocks(path, section) for row in block):
        for name in names:
            if name not in bones:
                raise FileFormatError(path, number, f"unknown bone {name!r} in the hierarchy")
        for child in names[1:]:
            if child in parents or child == ROOT:
                raise FileFormatError(path, number, f"bone {child!r} has a second parent")
            parents[child] = names[0]
    for name in bones:
        if name not in parents and name != ROOT:
            raise FileFormatError(path, section.line, f"bone {name!r} has no parent")
    return parents


def _ordered(path: str | Path, bones: dict[str, Bone], parents: dict[str, str]) -> tuple[Bone, ...]:
    """Bones in the order of the file, but every parent before its children."""
    done: dict[str, Bone] = {ROOT: bones[ROOT]}
    while len(done) < len(bones):
        ready = [n for n in bones if n not in done and parents[n] in done]
        if not ready:
            circle = ", ".join(n for n in bones if n not in done)
            raise FileFormatError(path, None, f"the hierarchy runs in a circle: {circle}")
        done |= {ready[0]: replace(bones[ready[0]], parent=parents[ready[0]])}
    return tuple(done.values())


def _triple(path: str | Path, line: int, words: list[str], *, what: str, scale: float) -> Triple:
    x, y, z = exactly(path, line, words, 3, what)
    return x * scale, y * scale, z * scale


def _axis_order(path: str | Path, line: int, words: list[str]) -> str:
    order = "".join(words).upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise FileFormatError(path, line, f"axis order must be XYZ in some order; got {order!r}")
    return order


def _direction(path: str | Path, line: int, words: list[str]) -> Triple:
    x, y, z = exactly(path, line, words, 3, "direction")
    norm = math.hypot(x, y, z)
    if norm == 0:
        raise FileFormatError(path, line, "direction must not be zero")
    return x / norm, y / norm, z / norm


def _length(path: str | Path, line: int, words: list[str]) -> float:
    length = exactly(path, line, words, 1, "length")[0]
    if length < 0:
        raise FileFormatError(path, line, f"length must not be negative; got {length:g}")
    return length


def _name(path: str | Path, line: int, words: list[str]) -> str:
    if len(words) != 1:
        raise FileFormatError(path, line, f"one name is needed; got {' '.join(words)!r}")
    return words[0]
