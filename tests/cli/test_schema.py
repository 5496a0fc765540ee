"""`staf schema`: every file that ships is valid by it, what a user mistypes is not."""

from __future__ import annotations

import json
import sys
from typing import Any

import composing
import pytest
from command_line import ROOT
from omegaconf import OmegaConf

from staf_torch.cli import schema
from staf_torch.cli.staf import main

CONF = ROOT / "conf"
FILES = sorted(path for path in CONF.rglob("*.yaml") if path.relative_to(CONF).parts[0] != "hydra")


@pytest.fixture(scope="module")
def whole() -> dict[str, Any]:
    return schema.schema()


def faults(whole: dict[str, Any], group: str, settings: Any) -> list[str]:
    """What is wrong with the settings of a file in the folder ``group`` of `conf/`."""
    jsonschema = pytest.importorskip("jsonschema")
    node = whole
    if group not in (".", "experiment"):
        node = {"$ref": f"#/$defs/{group.replace('/', '.')}", "$defs": whole["$defs"]}
    return [error.message for error in jsonschema.Draft202012Validator(node).iter_errors(settings)]


def test_a_file_that_ships_is_valid_and_with_a_wrong_key_it_is_not(whole: dict[str, Any]) -> None:
    pytest.importorskip("jsonschema").Draft202012Validator.check_schema(whole)
    for path in FILES:
        group = path.relative_to(CONF).parent.as_posix()
        settings = OmegaConf.to_container(OmegaConf.load(path))
        assert faults(whole, group, settings) == [], path
        assert faults(whole, group, {**settings, "raduis": 0.1}), path


def test_settings_of_a_run_are_valid(whole: dict[str, Any]) -> None:
    options = ["kernel=matern", "optimizer=exact", "sweep.records=table"]
    assert faults(whole, ".", OmegaConf.to_container(composing.settings(*options))) == []


@pytest.mark.parametrize(
    ("group", "settings"),
    [
        ("kernel", {"_target_": "staf_torch.GaussianKernel", "width": "wide"}),
        ("kernel", {"_target_": "staf_torch.GausianKernel"}),
        ("centers", {"radius": 0.1, "shrink": {"ofset": 0.0}}),
        ("optimizer", {"_target_": "staf_torch.optim.HeavyBall.from_settings", "inner_steps": 1.5}),
        ("adp", {"gains": {"critc": 0.1}}),
        (".", {"dtype": "float16"}),
        (".", {"task": "gradient_chasing"}),
        (".", {"adp": {"rollout": {"horizont": 1.0}}}),
        ("experiment", {"laws": {"worc": 11}}),
    ],
)
def test_what_is_mistyped_is_not_valid(group: str, settings: Any, whole: dict[str, Any]) -> None:
    assert faults(whole, group, settings)


@pytest.mark.parametrize(
    ("group", "settings"),
    [
        ("kernel", {"_target_": "cauchy.Cauchy", "width": 0.7}),
        ("target", {"_target_": "valley.Valley", "depth": [1, 2]}),
        ("centers", {"radius": "${spread}", "count": 6}),
        ("experiment", {"task": "closeness.closeness", "defaults": [{"override /kernel": "matern"}]}),
        (".", {"animation": True, "figures": False}),
        (".", {"figures": {"width": 3.4, "font": "9 serif"}}),
        (".", {"animation": "html", "adp": {"q": [[1.0, 0.0], [0.0, 2.0]]}}),
    ],
)
def test_what_a_user_may_write_is_valid(group: str, settings: Any, whole: dict[str, Any]) -> None:
    assert faults(whole, group, settings) == []


def test_comments_of_the_files_are_shown_by_the_editor(whole: dict[str, Any]) -> None:
    assert whole["properties"]["spread"] != {}
    assert whole["properties"]["settle_time"]["description"] == "s: metrics are taken from here on"
    assert whole["$defs"]["adp"]["properties"]["gain"]["description"] == "Gam(0) = gain I"
    launcher = whole["properties"]["hydra"]["properties"]["launcher"]["properties"]
    assert launcher["batch"]["description"].startswith("jobs in a tensor batch at most")


def test_the_command_prints_the_schema_of_a_group(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["staf", "schema", "adp/law"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    printed = json.loads(capsys.readouterr().out)
    assert printed["$ref"] == "#/$defs/adp.law"
    assert "adp.law" in printed["$defs"]
    monkeypatch.setattr(sys, "argv", ["staf", "schema", "kernels"])
    with pytest.raises(
        SystemExit, match=r"`staf schema\(group=...\)` must be one of 'experiment', 'adp/basis', "
    ):
        main()
