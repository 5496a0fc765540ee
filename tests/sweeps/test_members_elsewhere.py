"""Jobs of many members in the workers of a sweep: the command that began them keeps no member of theirs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from composing import compose

from staf_torch.results.files import MEMBERS
from staf_torch.sweeps import executors, members
from staf_torch.sweeps.batching import Batch, Failed, Outcome, Written, batches
from staf_torch.sweeps.hydra_compat import search_paths
from staf_torch.sweeps.job import InWorker, Origin

LINES = ["duration=0.05", "settle_time=0", "figures=false", "history=false", "trajectories=2"]
LINES += ["members=['kernel=own,gaussian', 'seed=range(2)']"]


def elsewhere(place: Path, conf: Path) -> Outcome:
    """Run the job as a worker does, with a folder of settings that `--config-dir` named."""
    (cfg,) = compose(LINES, [[]])
    *paths, schema = search_paths()
    paths += [("command-line", f"file://{conf}"), schema]
    batch = Batch([cfg], [str(place)], [InWorker(Origin(LINES, {}), tuple(paths))])
    (outcome,) = executors.unpack(executors.solve_elsewhere(*executors.pack(batch))).outcomes
    return outcome


@pytest.fixture
def conf(tmp_path: Path) -> Path:
    (tmp_path / "conf" / "kernel").mkdir(parents=True)
    own = "_target_: staf_torch.kernels.GaussianKernel\nwidth: 1.5\n"
    (tmp_path / "conf" / "kernel" / "own.yaml").write_text(own)
    return tmp_path / "conf"


def test_a_worker_goes_on_where_an_earlier_try_of_the_job_was_killed(
    conf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(members, "_PIECE", 2)
    whole = elsewhere(tmp_path / "whole", conf)
    assert isinstance(whole, Written)
    assert whole.metrics == {"members": 4, "failed": 0, "diverged": 0}
    compute, begun = members.compute, []

    def killed(cfgs: Any, places: Any, *rest: Any, **more: Any) -> Any:
        begun.append(places[0].name)
        if begun == ["0", "2"]:
            raise KeyboardInterrupt
        return compute(cfgs, places, *rest, **more)

    monkeypatch.setattr(members, "compute", killed)
    with pytest.raises(KeyboardInterrupt):
        elsewhere(tmp_path / "killed", conf)
    again = elsewhere(tmp_path / "killed", conf)
    assert isinstance(again, Written)
    assert begun == ["0", "2", "2"]
    assert (tmp_path / "killed" / MEMBERS).read_bytes() == (tmp_path / "whole" / MEMBERS).read_bytes()


def test_what_is_wrong_with_the_job_comes_back(tmp_path: Path) -> None:
    failed = elsewhere(tmp_path / "run", tmp_path)  # where there is no such kernel
    assert isinstance(failed, Failed)
    assert "own" in str(failed.error)


def test_jobs_of_many_members_share_no_batch() -> None:
    settings = {"task": "gradient_chase", "dt": 0.01, "duration": 1.0, "seed": 1}
    assert batches([settings | {"members": None}] * 2) == [[0, 1]]
    assert batches([settings | {"members": ["seed=0,1"]}] * 2) == [[0], [1]]
