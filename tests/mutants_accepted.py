"""Mutants that change nothing that anybody could see: (file, line, what changes, into what) -> why."""

from __future__ import annotations

_SPEED = "decides which of two ways that find the same is taken: the threshold is of speed alone"

ACCEPTED: dict[tuple[str, str, str, str], str] = {
    (
        "staf_torch/systems/integrators.py",
        "_PAYS = 10_000  # steps of a small batch in plain torch (some .1 ms each) that take as long as to "
        "compile",
        "10_000",
        "10001",
    ): _SPEED,
    ("staf_torch/systems/barrier.py", "left = s < 0", "s < 0", "(s <= 0)"): (
        "both branches are the same function at 0, value and slope"
    ),
}
