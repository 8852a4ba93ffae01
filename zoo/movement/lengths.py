"""How long the movements may be that a model of one length is given."""

from __future__ import annotations

from zoo.errors import MovementLengthError
from zoo.types import Layout

__all__ = ["check_end", "check_whole", "common_length"]


def common_length(label: str, layout: Layout) -> int:
    """The one length of all movements, in frames."""
    if layout.frames is None or layout.frames < 3:
        raise MovementLengthError(
            f"{label} needs movements of one common length of at least 3 frames; got "
            f"{'several lengths' if layout.frames is None else layout.frames}: "
            "bring them to n frames by data.resampled(n), or cut them by data.windows(n)"
        )
    return layout.frames


def check_whole(label: str, frames: int, given: int) -> None:
    """Refuse movements that are not as long as those trained on."""
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
