"""How long the movements may be that a model of one length is given."""

from __future__ import annotations

from zoo.errors import MovementLengthError
from zoo.types import Layout

__all__ = ["check_end", "check_whole", "checked_span"]

LEAST = 3


def checked_span(label: str, layout: Layout) -> tuple[int, int]:
    """Frames of the shortest and of the longest movement."""
    if layout.frames is None and layout.span is None:
        raise MovementLengthError(f"{label} needs movements whose lengths are known; got none")
    shortest, longest = layout.span or (layout.frames or 0, layout.frames or 0)
    if shortest < LEAST:
        raise MovementLengthError(
            f"{label} needs movements of at least {LEAST} frames; got one of {shortest}: leave it "
            "out, or bring all to n frames by data.resampled(n)"
        )
    return shortest, longest


def check_whole(label: str, frames: int, given: int, ragged: bool = False) -> None:
    """Refuse movements unlike those trained on: of one length, or of several."""
    if ragged and given >= LEAST:
        return
    if given != frames:
        raise MovementLengthError(
            f"movements have {given} frames; this {label} was made for {frames}: a part of a "
            f"movement can be forecast or imputed, a longer one is cut by data.windows({frames})"
        )


def check_end(label: str, frames: int, given: int, horizon: int) -> None:
    """Refuse what lies after the end of the movements trained on: nothing is known of it."""
    if given + horizon > frames:
        asked = f"{given} frames" if not horizon else f"{horizon} frames after {given}"
        room = f"forecast at most {frames - given}, or " if horizon and given < frames else ""
        raise MovementLengthError(
            f"{label} was trained on movements that end after {frames} frames; got {asked}: {room}"
            "train on longer movements, or take a model that goes on for any time "
            "(vae-dmp-rhythmic, dvbf)"
        )
