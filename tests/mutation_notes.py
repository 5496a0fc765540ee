"""A sample of mutants and what was said of them so far, in a file: for `mutation.py`.

A mutant is named by its file, its line's text, what changes, and how many like it come before in the file,
so that a later version of the package has it too.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from mutants import Mutant
from mutants_accepted import accepted
from mutation_judge import Verdict

Name = tuple[str, str, str, str, int]


class Notes:
    """The sample, in its order, and the latest verdict of every mutant.

    Args:
        path: of the file, which is made where there is none; None keeps nothing.
        found: every mutant of the package.
        drawn: the sample of a file that is new.
    """

    def __init__(self, path: Path | None, found: Iterable[Mutant], drawn: Sequence[Mutant]) -> None:
        """Read what is there."""
        here = dict(_named(found))
        self._path = path
        self._verdicts: dict[int, Verdict] = {}
        if path is None or not path.exists():
            self.sample: list[Mutant | None] = list(drawn)
            names = {id(mutant): name for name, mutant in here.items()}
            self._write({"sample": [names[id(mutant)] for mutant in drawn]})
            return
        first, *rest = map(json.loads, path.read_text().splitlines())
        self.sample = [here.get((*map(str, name[:4]), name[4])) for name in first["sample"]]
        for line in rest:
            mutant = self.sample[line["at"]]
            if mutant is not None:
                self._verdicts[line["at"]] = Verdict(mutant, *line["verdict"])

    def _write(self, line: object) -> None:
        if self._path is not None:
            with self._path.open("a") as file:
                print(json.dumps(line), file=file)

    def left(self, *, again: bool, without: Sequence[str]) -> list[tuple[int, Mutant]]:
        """Mutants without a verdict, with their places in the sample.

        Args:
            again: those that were not killed are left too.
            without: packages whose mutants are not.
        """
        done = {at for at, each in self._verdicts.items() if each.said == "killed" or not again}
        return [
            (at, mutant)
            for at, mutant in enumerate(self.sample)
            if mutant is not None and at not in done and mutant.room not in without
        ]

    def add(self, at: int, verdict: Verdict) -> None:
        """Keep a verdict on the mutant at a place of the sample."""
        self._verdicts[at] = verdict
        self._write({"at": at, "verdict": verdict[1:]})

    def verdicts(self) -> list[Verdict]:
        """What is said of the sample, as far as it goes without a gap; what is accepted is so by now."""
        end = next(
            (at for at, each in enumerate(self.sample) if each is not None and at not in self._verdicts),
            len(self.sample),
        )
        found = (each for at, each in sorted(self._verdicts.items()) if at < end)
        return [each._replace(said="accepted") if accepted(each.mutant) else each for each in found]


def _named(found: Iterable[Mutant]) -> Iterator[tuple[Name, Mutant]]:
    seen: Counter[tuple[str, str, str, str]] = Counter()
    for mutant in found:
        yield (*mutant.key, seen[mutant.key]), mutant
        seen[mutant.key] += 1
