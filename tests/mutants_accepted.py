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
    (
        "staf_torch/adp/shooting/newton.py",
        "_SHORTER = (0.5, 0.25, 0.1, 0.03, 0.01)  # shares of the Newton step, where the whole one does not "
        "pay",
        "0.03",
        "0.06",
    ): "another share of a step that is tried: the search ends at the same optimum",
}
