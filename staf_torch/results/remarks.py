"""What a reader of several runs should know: other versions, and settings that differ unasked."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from .._version import __version__
from .run import Collection, Run

_SHOWN = 3  # values of a setting that a remark names


def versions(rows: Sequence[Run]) -> Iterator[str]:
    """One remark for each other version of which there are runs."""
    others = dict.fromkeys(run.version for run in rows if run.version not in (None, __version__))
    for version in others:
        those = [run for run in rows if run.version == version]
        yield (
            f"{len(those)} of {len(rows)} runs were written by staf_torch {version}, and this is "
            f"{__version__}: their numbers may mean something else (the first is {those[0].directory})"
        )


def mixed(found: Collection) -> Iterator[str]:
    """One remark for each setting that differs although nobody swept it, and for different builds."""
    for key in found.unswept:
        values: dict[str, list[Run]] = {}
        for run in found.rows:
            value = run.value(key)
            values.setdefault(value if isinstance(value, str) else json.dumps(value), []).append(run)
        counts = [f"{value} in {len(runs)} (as {runs[0].directory})" for value, runs in values.items()]
        more = f" and {len(counts) - _SHOWN} others" if len(counts) > _SHOWN else ""
        yield f"`{key}` differs between runs although nobody swept it: {', '.join(counts[:_SHOWN])}{more}"
