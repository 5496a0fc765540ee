"""`staf_torch.run` and `staf_torch.sweep` with a stand-in for Hydra: what is asked, returned and raised."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf
from sweep_runs import write_run

from staf_torch.sweeps import python_api
from staf_torch.sweeps.hydra_compat import BrokenSweep
from staf_torch.sweeps.job import PRINTS, Refused


class App:
    """Stands for an application: notes what it is asked for, and ends as it is told."""

    def __init__(self, place: Path, ends: BaseException | None = None, sweeps: bool = False) -> None:
        self.place, self.ends, self.sweeps = place, ends, sweeps
        self.asked: list[Any] = []

    def is_sweep(self, overrides: Any) -> bool:
        return self.sweeps

    def run(self, task: Any, overrides: Any) -> Path:
        self.asked.append((task.__name__, overrides, PRINTS.get()))
        if self.ends is not None:
            raise self.ends
        return self.place

    sweep = run


@pytest.fixture
def app(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> App:
    made = App(tmp_path / "run")

    @contextmanager
    def application() -> Iterator[App]:
        yield made

    monkeypatch.setattr(python_api, "application", application)
    return made


def test_a_run_has_the_figures_that_were_drawn_of_it(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    write_run(app.place, {"seed": 1}, {"ball_error": 0.5})
    (app.place / "figures").mkdir()
    drawn = [(f"figure {name}", name.encode()) for name in ("b", "a", "of another run")]
    for name in ("a", "b", "c"):
        (app.place / "figures" / f"{name}.png").write_bytes(name.encode())

    @contextmanager
    def kept() -> Iterator[Any]:
        yield drawn

    monkeypatch.setattr(python_api, "keep_figures", kept)
    found = python_api.run("seed=1", directory="it's one")
    assert app.asked == [
        ("_execute_silently", ["seed=1", r"hydra.run.dir='it\'s one'"], False),
    ]
    assert found.figures() == {"a": "figure a", "b": "figure b"}
    assert found.metrics["ball_error"] == 0.5
    assert PRINTS.get()
    python_api.run("seed=1")
    assert app.asked[1][1] == ["seed=1"]
    app.sweeps = True
    with pytest.raises(ValueError, match=r"must be one run; got 'seed=1 dt=2', which is a sweep: call"):
        python_api.run("seed=1", "dt=2")
    assert len(app.asked) == 2


def test_a_sweep_is_one_of_the_directory_that_is_named(app: App) -> None:
    write_run(app.place / "0", {"seed": 1}, {"ball_error": 0.5})
    assert len(python_api.sweep("seed=1,2", directory=Path("two words"))) == 1
    assert len(python_api.sweep("seed=1,2")) == 1
    assert app.asked == [
        ("execute", ["seed=1,2", "hydra.sweep.dir='two words'"], False),
        ("execute", ["seed=1,2"], False),
    ]
    assert PRINTS.get()


def test_a_run_is_drawn_again_from_its_own_overrides(app: App, tmp_path: Path) -> None:
    write_run(app.place / "0", {"seed": 1}, {"ball_error": 0.5})
    write_run(app.place / "1", {"seed": 2}, {"ball_error": 0.5})
    runs = python_api.read_runs(app.place)
    (app.place / "1" / "members.json").write_text("{}")
    asked: list[Any] = []

    def again(*lines: str, directory: str) -> Any:
        asked.append((lines, Path(directory).is_dir(), directory))
        return SimpleNamespace(figures=lambda: {"a": Path(directory).is_dir()})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(python_api, "run", again)
        assert runs[0].figures() == {"a": True}
        ((lines, there, place),) = asked
        assert lines == ("seed=1", "figures=true", "history=false", "tracker=none")
        assert there
        assert not Path(place).exists()
        with pytest.raises(ValueError, match=r"needs the run\.json of a run without members; got .*/1\."):
            runs[1].figures()
        (app.place / "1" / "members.json").unlink()
        for odd in (SimpleNamespace(directory=app.place / "0", member=3), runs[1]):
            (app.place / "1" / "run.json").unlink(missing_ok=True)
            with pytest.raises(ValueError, match="of a run without members"):
                python_api._draw_again(odd)  # type: ignore[arg-type]
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("error", "begun", "failed", "raised"),
    [
        (RuntimeError("odd"), True, True, None),
        (RuntimeError("odd"), True, False, RuntimeError),
        (RuntimeError("odd"), False, False, RuntimeError),
        (RuntimeError("odd"), None, False, RuntimeError),
        (KeyboardInterrupt(), True, True, KeyboardInterrupt),
        (KeyboardInterrupt(), None, False, KeyboardInterrupt),
        (SystemExit(3), True, True, SystemExit),
    ],
)
def test_a_sweep_whose_jobs_alone_failed_has_its_rows(
    error: BaseException, begun: bool | None, failed: bool, raised: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    """``begun`` None: no sweep was there to be broken."""
    place, closed = tmp_path / "sweep", []
    if begun:
        write_run(
            place / "0", {"seed": 1}, None if failed else {}, status="failed" if failed else "completed"
        )
    cfg = OmegaConf.create({"hydra": {"sweep": {"dir": str(place)}}})
    broken = None if begun is None else BrokenSweep(cfg, None)
    monkeypatch.setattr(python_api, "broken_sweep", lambda error: broken)
    monkeypatch.setattr(python_api.callbacks, "close", closed.append)
    if raised is None:
        assert python_api._ended_early(error) == place
    else:
        with pytest.raises(raised) as told:
            python_api._ended_early(error)
        said = "staf: interrupted" if raised is KeyboardInterrupt else str(error)
        assert str(told.value).startswith(said)
    assert closed == ([] if broken is None else [broken])


@pytest.mark.parametrize(
    ("error", "kind", "said"),
    [
        (ValueError("odd"), ValueError, "odd"),
        (RuntimeError("odd"), RuntimeError, "odd"),
        (Refused(ValueError("refused")), SystemExit, "staf: refused"),
        (SystemExit("staf: ended"), ValueError, "ended"),
        (HydraException("of Hydra"), ValueError, "of Hydra"),
    ],
)
def test_errors_are_those_of_the_library(error: Any, kind: Any, said: str) -> None:
    with pytest.raises(kind) as told, python_api._plain_errors():
        raise error
    assert str(told.value) == said


def test_a_refusal_is_the_error_of_the_run() -> None:
    cause = RuntimeError("the cause")
    with pytest.raises(RuntimeError, match="the cause") as told, python_api._plain_errors():
        raise Refused(cause) from cause
    assert told.value is cause


def test_a_task_is_silent_before_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Any] = []
    monkeypatch.setattr(python_api, "silence_terminal", lambda: done.append("silent"))
    monkeypatch.setattr(python_api, "execute", lambda cfg: done.append(cfg) or 2.5)
    cfg: Mapping[str, Any] = {"a": 1}
    assert python_api._execute_silently(cfg) == 2.5  # type: ignore[arg-type]
    assert done == ["silent", cfg]
