"""What a run says about itself, and what is asked of the settings of a sweep."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from staf_torch.results import run_record


@pytest.mark.parametrize("said", [True, False, None, "true", 1])
def test_runs_made_otherwise_count_only_where_that_is_said_by_true(said: object) -> None:
    cfg = OmegaConf.create({run_record.SETTINGS: {"resume_anyway": said}})
    assert run_record.resumed_anyway(cfg) is (said is True)
    assert not run_record.resumed(cfg)


def test_settings_without_a_sweep_resume_nothing() -> None:
    assert not run_record.resumed(OmegaConf.create({}))
    assert not run_record.resumed_anyway(OmegaConf.create({}))
    assert run_record.resumed(OmegaConf.create({run_record.SETTINGS: {"resume": "outputs/1"}}))
