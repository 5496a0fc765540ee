"""`staf-export` of runs that somebody made to do harm: nothing of theirs runs, and a sentence says why."""

from __future__ import annotations

import pickle
import resource
import shutil
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from composing import settings
from hostile_runs import EXPORTS
from omegaconf import OmegaConf

from staf_torch.cli.deployable import deployable
from staf_torch.cli.export import export
from staf_torch.cli.staf import config_directory
from staf_torch.deploy import sheet
from staf_torch.experiments.registry import experiment
from staf_torch.settings.trust import constructors, limited
from staf_torch.sweeps.hydra_compat.program import HAS_WHITELIST


class Evil:
    """Leaves a file when it is unpickled."""

    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self) -> Any:
        return Path.touch, (self.victim,)


@pytest.fixture(scope="module")
def chase(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "chase"
    cfg = settings("centers.count=6", "duration=0.1", "trajectories=2", "figures=false")
    (run / ".hydra").mkdir(parents=True)
    OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
    experiment(cfg.task)(cfg, run)
    return run


@pytest.fixture
def run(chase: Path, tmp_path: Path) -> Path:
    torch.save(Evil(tmp_path / "owned"), tmp_path / "evil.pt", pickle_module=pickle)
    return Path(shutil.copytree(chase, tmp_path / "run"))


@pytest.mark.parametrize("name", EXPORTS)
def test_a_hostile_run_is_refused_in_a_sentence(name: str, run: Path, tmp_path: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    EXPORTS[name](run)
    with pytest.raises(ValueError, match=r"\w") as refused:
        deployable(run)
    assert not (tmp_path / "owned").exists()
    assert "Error" not in str(refused.value).partition("(")[0]
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500 * 1024


def test_the_file_that_would_be_unpickled_does_harm(run: Path, tmp_path: Path) -> None:
    torch.load(tmp_path / "evil.pt", weights_only=False)
    assert (tmp_path / "owned").exists()


def test_the_refusal_shows_the_line_that_asks_for_trust(run: Path) -> None:
    EXPORTS["a target behind the library's name"](run)
    with pytest.raises(
        ValueError, match=r"config\.yaml:\d+: kernel: \{_target_: 'staf_torch\.\$\{x\}'.*\n.*--trust"
    ):
        deployable(run)


@pytest.mark.parametrize("name", ["a target", "a target in the decoded text of another key"])
def test_trust_lifts_every_limit(name: str, run: Path, tmp_path: Path) -> None:
    if HAS_WHITELIST and "decoded" in name:
        pytest.skip("Hydra 1.4.0rc3 cannot copy a node that an interpolation makes")
    EXPORTS[name](run)
    with pytest.raises(ValueError, match=r"\w"):
        deployable(run, trust=True)  # runs, and finds no kernel
    assert (tmp_path / "owned").exists()


@pytest.mark.parametrize("linked", ["export", "export/approximator.pt2"])
def test_nothing_is_written_through_a_link(linked: str, run: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (run / linked).parent.mkdir(exist_ok=True)
    (run / linked).symlink_to(victim if linked == "export" else victim / "file")
    with pytest.raises(ValueError, match="is a link"):
        export(run, "pt2")
    assert list(victim.iterdir()) == []


@pytest.mark.needs_compiler
def test_the_name_of_a_folder_is_neither_c_nor_told_to_the_terminal(run: Path, tmp_path: Path) -> None:
    evil = "__attribute__((constructor)) static void evil(void)"
    (tmp_path / "x").write_text(
        f'int system(const char *); {evil} {{ system("touch {tmp_path}/owned"); }}\nvoid staf() {{}}\n'
    )
    moved = tmp_path / 'x"\n#pragma \x1b[2J'
    run.rename(moved)
    page = sheet.markdown(export(moved, "c", calls=10))
    assert not (tmp_path / "owned").exists()
    assert "\x1b" not in page
    assert "pragma" in page


def test_every_part_of_the_settings_may_be_built_without_trust() -> None:
    targets = {
        line.partition("_target_:")[2].split("#")[0].strip()
        for path in Path(config_directory()).rglob("*.yaml")
        for line in path.read_text().splitlines()
        if "_target_:" in line
    }
    asking = ("null", "staf_torch.settings.chase.load", "staf_torch.systems.MujocoPlant")
    foreign = {name for name in targets if "callbacks" in name or name in asking}
    assert not {*asking} & constructors()
    assert targets - foreign - constructors() == set()
    assert len(targets - foreign) > 30


def test_building_takes_no_more_memory_than_its_limit() -> None:
    with pytest.raises(ValueError, match="takes more memory to build"), limited("this"):
        torch.zeros(2**27, dtype=torch.float64)
    assert torch.zeros(2**26, dtype=torch.float64).numel()


def test_building_takes_no_more_time_than_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("staf_torch.settings.trust._SECONDS", 0.05)
    with pytest.raises(ValueError, match=r"takes more than 0\.05 s"), limited("this"):
        all(n == 0 for n in iter(int, 1))  # zeros without end


def test_the_clock_is_stopped_when_all_is_built() -> None:
    with limited("this"):
        assert signal.getitimer(signal.ITIMER_PROF)[0] > 0
    assert signal.getitimer(signal.ITIMER_PROF) == (0.0, 0.0)


def test_building_in_a_thread_takes_no_more_time_than_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("staf_torch.settings.trust._SECONDS", 0.05)

    def build() -> str:
        with limited("this"):
            time.sleep(0.2)  # waiting is no building
        try:
            with limited("this"):
                all(n == 0 for n in iter(int, 1))
        except ValueError as error:
            return str(error)
        return "built"

    with ThreadPoolExecutor(1) as pool:
        assert "takes more than 0.05 s" in pool.submit(build).result(60)
