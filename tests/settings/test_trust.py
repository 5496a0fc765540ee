"""How much the settings of a run that somebody else made may ask for."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import yaml

from staf_torch.results.settings_file import read_settings
from staf_torch.settings import trust

LIMITS = [(name, most) for name, most in trust._SIZES.items() if math.isfinite(most)]


@pytest.mark.parametrize(("name", "most"), [*LIMITS, ("points", trust._SIZE), ("centers.count", trust._SIZE)])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_number_at_its_limit_is_accepted_and_one_more_is_refused(
    name: str, most: float, sign: int, tmp_path: Path
) -> None:
    outer, _, inner = name.rpartition(".")
    for value, fine in ((sign * most, True), (sign * (most + 1), False)):
        tree = {inner: value}
        (tmp_path / "config.yaml").write_text(yaml.safe_dump({outer: tree} if outer else tree))
        read = read_settings(tmp_path / "config.yaml", tmp_path)
        if fine:
            assert trust.checked(read, "config.yaml")
        else:
            with pytest.raises(ValueError, match=re.escape(f"and {most:g} is the most")):
                trust.checked(read, "config.yaml")


@pytest.mark.parametrize("count", [trust._MOST_ENTRIES, trust._MOST_ENTRIES + 1])
def test_a_list_may_have_so_many_entries_and_no_more(count: int, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump({"radii": [0.5] * count}))
    read = read_settings(path, tmp_path)
    if count == trust._MOST_ENTRIES:
        assert trust.checked(read, "config.yaml")["radii"] == [0.5] * count
    else:
        with pytest.raises(
            ValueError, match=f"lists {count} entries, and {trust._MOST_ENTRIES} are the most"
        ):
            trust.checked(read, "config.yaml")
