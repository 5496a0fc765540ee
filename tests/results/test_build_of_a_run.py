"""Which files a run's record of modules names."""

from __future__ import annotations

from pathlib import Path

import pytest

from staf_torch.results import build


@pytest.mark.parametrize("folder", ["mine", "site-packages", "dist-packages"])
def test_a_module_is_recorded_with_what_it_imports_and_an_installed_one_with_its_package_alone(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = tmp_path / folder
    files = {
        "plants/__init__.py": "",
        "plants/own.py": "import other, plants.absent\nfrom . import near\nfrom plants.sub.far import x\n",
        "plants/near.py": "",
        "plants/sub/__init__.py": "from .. import own\n",  # in a circle
        "plants/sub/far.py": "import torch\nx = 1\n",
        "other.py": "import further\n",
        "further.py": "",
    }
    for name, text in files.items():
        (base / name).parent.mkdir(parents=True, exist_ok=True)
        (base / name).write_text(text)
    monkeypatch.syspath_prepend(str(base))
    found = build.modules({"target._target_": "plants.own.x"})
    package = {name for name in found if name.partition(".")[0] == "plants"}
    assert package >= {"plants.own", "plants.near", "plants.sub.far"}
    assert set(found) - package == ({"other", "further"} if folder == "mine" else set())


def test_long_values_are_cut_and_a_module_without_a_file_has_no_hash() -> None:
    assert build._shown("a" * 80) == "a" * 80
    assert build._shown("a" * 81) == "a" * 77 + "..."
    assert build._shown([1, 2]) == "[1, 2]"
    assert build._hash("no_module_of_this_name.anywhere") is None
    assert build._hash("staf_torch.results.build") is not None


@pytest.mark.parametrize("name", ["metrics.json", "history.npz", "table.csv", "figure.png", "table.md"])
def test_a_file_that_is_gone_is_missed_where_it_holds_numbers(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"1")
    recorded = {name: [1, build.digest(tmp_path / name)]}
    assert build.damage(tmp_path, recorded, thorough=True) is None
    (tmp_path / name).unlink()
    missing = f"{name} is missing" if name.endswith(("json", "npz", "csv")) else None
    assert build.damage(tmp_path, recorded, thorough=True) == missing
    assert build.damage(tmp_path, recorded, thorough=False) is None
