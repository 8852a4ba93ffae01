"""Parts of a record: by group, by channel, by the values of group columns."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from numbers import Real

import numpy as np

from zoo.arguments import list_of, seed_of
from zoo.errors import UnknownNameError

__all__ = ["matching_rows", "named_columns", "nearest", "split_rows"]


def split_rows(
    groups: Mapping[str, Sequence[str]],
    *,
    by: str,
    parts: Sequence[float],
    seed: int,
    count: int,
) -> list[list[int]]:
    """Rows of every part; rows that share their value in column ``by`` stay together.

    Groups are shuffled by ``seed`` and dealt out until every part has its share of the *rows*, so
    that groups of unequal size still meet the shares as nearly as whole groups can; rows keep
    their order within a part. ``by="frame"``, where no column has that name, deals single rows.

    >>> split_rows({"subject": list("aabbcc")}, by="subject", parts=(2, 1), seed=0, count=6)
    [[0, 1, 4, 5], [2, 3]]
    """
    shares, seed = _shares(parts), seed_of(seed)
    members = _members(groups, by, count)
    if len(members) < len(shares):
        raise ValueError(
            f"{len(shares)} parts need at least {len(shares)} distinct values of {by!r}; "
            f"there {'is' if len(members) == 1 else 'are'} {len(members)}"
        )
    order = np.random.default_rng(seed).permutation(len(members))
    dealt = _deal([members[i] for i in order], shares, count)
    return [sorted(row for member in part for row in member) for part in dealt]


def matching_rows(
    groups: Mapping[str, Sequence[str]], where: Mapping[str, object], count: int
) -> list[int]:
    """Rows whose group columns have the given values; a collection of values means any of them.

    >>> matching_rows({"subject": ["35", "35", "49"], "trial": ["1", "2", "18"]},
    ...     {"subject": 35, "trial": ["2", "3"]}, 3)
    [1]
    """
    rows = set(range(count))
    for column, wanted in where.items():
        values = _column(groups, column)
        allowed = _texts(wanted)
        rows &= {i for i, v in enumerate(values) if v in allowed}
    if not rows:
        asked = ", ".join(f"{k}={v!r}" for k, v in where.items())
        have = "; ".join(f"{k}: {_shown(sorted(set(groups[k])))}" for k in where)
        raise ValueError(f"nothing matches {asked}; the data have {have}")
    return sorted(rows)


def named_columns(names: Sequence[str], wanted: Sequence[str], what: str) -> list[int]:
    """Positions of the wanted names, in the order wanted.

    >>> named_columns(["hip", "knee", "foot"], ["foot", "hip"], "channel")
    [2, 0]
    """
    if isinstance(wanted, str):
        raise TypeError(f"{what} names must come as a list; got the string {wanted!r}")
    wanted = list_of(wanted, f"{what} names")
    if not wanted:
        raise ValueError(f"at least one {what} name is needed")
    if any(not isinstance(name, str) for name in wanted):
        raise TypeError(f"{what} names must be text; got {wanted}")
    if len(set(wanted)) != len(wanted):
        raise ValueError(f"{what} names must be distinct; got {list(wanted)}")
    for name in wanted:
        if name not in names:
            raise UnknownNameError(f"no {what} {name!r}{nearest(name, names)}")
    return [list(names).index(name) for name in wanted]


def nearest(name: str, names: Collection[str]) -> str:
    """The end of an error on an unknown name: what may have been meant, or what there is.

    >>> nearest("subjekt", ["subject", "trial"])
    '; did you mean subject?'
    """
    near = difflib.get_close_matches(name, list(names), n=3, cutoff=0.5)
    if near:
        return f"; did you mean {' or '.join(near)}?"
    return f"; there are {_shown(list(names))}" if names else "; there are none"


def _shares(parts: Sequence[float]) -> list[float]:
    wanted = isinstance(parts, Iterable) and not isinstance(parts, str)
    if not wanted or not all(isinstance(p, Real) for p in parts):
        raise TypeError(f"parts must be a list of shares, such as (0.6, 0.4); got {parts!r}")
    if not parts or any(not (math.isfinite(p) and p > 0) for p in parts):
        raise ValueError(f"parts must be positive shares; got {tuple(parts)}")
    total = math.fsum(parts)
    return [p / total for p in parts]


def _members(groups: Mapping[str, Sequence[str]], by: str, count: int) -> list[list[int]]:
    if by == "frame" and by not in groups:
        return [[i] for i in range(count)]
    members: dict[str, list[int]] = {}
    for row, value in enumerate(_column(groups, by)):
        members.setdefault(value, []).append(row)
    return list(members.values())


def _deal(members: list[list[int]], shares: list[float], count: int) -> list[list[list[int]]]:
    """Every group goes to the part that lacks most; the last groups to parts that have none."""
    parts: list[list[list[int]]] = [[] for _ in shares]
    lacking = [share * count for share in shares]
    for left, member in zip(range(len(members), 0, -1), members, strict=True):
        empty = [p for p, part in enumerate(parts) if not part]
        target = max(empty if left <= len(empty) else range(len(parts)), key=lambda p: lacking[p])
        parts[target].append(member)
        lacking[target] -= len(member)
    return parts


def _column(groups: Mapping[str, Sequence[str]], column: str) -> Sequence[str]:
    if not isinstance(column, str):
        raise TypeError(f"a group column is named by text; got {column!r}")
    if column not in groups:
        raise UnknownNameError(f"no group column {column!r}{nearest(column, groups)}")
    return groups[column]


def _texts(wanted: object) -> set[str]:
    if isinstance(wanted, Collection) and not isinstance(wanted, str):
        return {str(w) for w in wanted}
    return {str(wanted)}


def _shown(names: Sequence[str]) -> str:
    return ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
