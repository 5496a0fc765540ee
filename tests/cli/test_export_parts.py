"""What `staf-export` asks of its parts and says of them, with parts that compute something known."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from staf_torch import __version__
from staf_torch.cli import export as command
from staf_torch.cli.deployable import Deployable, Learner
from staf_torch.cli.export import export, export_learning, main
from staf_torch.deploy.sheet import Latency, Port, Work, machine, markdown

POINTS = torch.arange(14, dtype=torch.float64).reshape(7, 2) + 1.0
WORK = Work(1, 2, 3, 4, 5)
ENDINGS = {"onnx": ".onnx", "pt2": ".pt2", "aoti": ".aoti.pt2", "c": ".h"}


class Scaled(nn.Module):
    """V = x1 + x2 and a gradient 3 x, by a factor that single precision has a little larger."""

    def __init__(self, dtype: torch.dtype, rough: float = 1.001) -> None:
        super().__init__()
        self.scale = rough if dtype == torch.float32 else 1.0

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.scale * x.sum(-1), self.scale * 3 * x


class Adding(nn.Module):
    """A controller that adds up what it has seen: u = c + dt * numbers, with c from one step to the next."""

    draws = 2

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.inputs = inputs

    def init(self, x: Tensor) -> Tensor:
        return x.sum(-1)

    def step(self, x: Tensor, seen: Tensor, numbers: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        scale = 1.001 if x.dtype == torch.float32 else 1.0
        u = scale * (seen + dt * numbers.sum((-1, -2)))
        return u[:, None].expand(-1, self.inputs), seen + x.sum(-1)

    def all_steps(self, states: Tensor, uniform: Tensor, dt: float) -> Tensor:
        """The controls of consecutive steps, without a loop."""
        before = torch.cat([states[:1].sum(-1), states[:1].sum() + states.sum(-1).cumsum(0)[:-1]])
        scale = 1.001 if states.dtype == torch.float32 else 1.0
        return (scale * (before + dt * uniform.sum((-1, -2))))[:, None].expand(-1, self.inputs)


class Parts:
    """What the command was seen to ask of its parts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: dict[str, Any] = {}
        self.off = 0.0  # how far, relatively, a file is from the library
        self.rough = 1.001
        self.rows: list[int] = []
        self.called: list[tuple[int, ...]] = []
        ports = (Port("value", None, "J", "V^"), Port("gradient", 2, "J/m", "grad V^"))
        self.found = Deployable(
            *("approximator", "A sentence.", lambda dtype: Scaled(dtype, self.rough), POINTS),
            *(Port("state", 2, "m", "a ball"), ports, "0.0.9"),
        )
        self.learner = Learner(
            *("A learner.", Adding(3), 0.5, POINTS, torch.linspace(-1, 1, 28).reshape(7, 2, 2).double()),
            *((Port("x", 2, "m", ""), Port("uniform", 4, "1", "")), (Port("u", 3, "N", ""),), None),
        )
        for name in ("deployable", "learning"):
            monkeypatch.setattr(command, name, self.reads(name))
        monkeypatch.setattr(command, "trace", self.trace)
        monkeypatch.setattr(command.sheet, "work", lambda program: WORK)
        monkeypatch.setattr(command.sheet, "latency", self.latency)
        monkeypatch.setattr(command, "_NEEDS", {})
        monkeypatch.setattr(command.c_header, "need_c_compiler", lambda: self.seen.update(asked=True))
        for name in ("onnx", "program", "package"):
            monkeypatch.setattr(command.formats, f"export_{name}", self.writes(name))
            monkeypatch.setattr(command.formats, f"runner_{name}", self.runs(name))
        for name in ("c", "learning_c"):
            monkeypatch.setattr(command.c_header, f"runner_{name}", self.runs(name))
        monkeypatch.setattr(command.c_header, "export_c", self.writes_c)
        monkeypatch.setattr(command, "export_learning_c", self.writes_learning)

    def reads(self, name: str) -> Callable[..., object]:
        def read(run: Path, row: int, *, trust: bool) -> object:
            self.seen["read"] = run, row, trust
            return self.found if name == "deployable" else self.learner

        return read

    def trace(self, module: Scaled, points: Tensor, *, batch: int | None) -> Scaled:
        self.seen["traced"] = points.dtype, tuple(points.shape), batch
        return module

    def writes(self, name: str) -> Callable[..., None]:
        def write(program: Scaled, path: Path, *more: object) -> None:
            path.write_text("a file")
            self.seen["wrote"], self.module = (name, *more), program

        return write

    def writes_c(self, module: Scaled, example: Tensor, path: Path, names: list[str], *, note: str) -> Any:
        path.write_text("a header")
        self.seen["wrote"], self.module = ("c", example.dtype, names, note), module
        return self

    def writes_learning(self, controller: Adding, x: Tensor, path: Path, *, dt: float, note: str) -> Any:
        path.write_text("a header")
        self.seen["wrote"], self.module = (x.dtype, tuple(x.shape), dt, note), controller
        return self

    def work(self, entries: int, dtype: torch.dtype) -> Work:
        self.seen["work"] = entries, dtype
        return WORK

    def runs(self, name: str) -> Callable[..., object]:
        def runner(path: Path, *more: object) -> Callable[..., Any]:
            self.seen["runner"] = name, more

            def call(x: Tensor, uniform: Tensor | None = None) -> Any:
                if uniform is not None:
                    self.called.append((*x.shape, *uniform.shape))
                    return (1 + self.off) * self.module.all_steps(x, uniform, self.learner.dt)
                self.rows.append(len(x))
                return tuple((1 + self.off) * part for part in self.module(x))

            return call

        return runner

    def latency(self, call: Callable[[Tensor], object], x: Tensor, calls: int) -> Latency:
        self.seen["timed"] = tuple(x.shape), calls
        call(x)
        return Latency(calls, 1.0, 2.0, 3.0)


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> Parts:
    return Parts(monkeypatch)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("to", list(ENDINGS))
def test_a_page_says_what_was_written_and_how_it_was_measured(
    to: str, dtype: str, parts: Parts, tmp_path: Path
) -> None:
    page = export(tmp_path / "run", to, dtype=dtype, row=1, calls=9)
    path, real = tmp_path / "run" / "export" / f"approximator{ENDINGS[to]}", getattr(torch, dtype)
    assert path.exists()
    assert parts.seen["read"] == (tmp_path / "run", 1, False)
    runtimes = {"onnx": "onnxruntime", "pt2": "eager torch", "aoti": "AOTInductor", "c": "C by ctypes"}
    errors = page.pop("float32_error")
    assert all(error == pytest.approx(1e-3, rel=1e-3) for error in errors.values())
    assert list(errors) == ["value", "gradient"]
    assert page.pop("torch") == torch.__version__
    assert page == {
        **{"file": path.name, "what": "A sentence.", "run": str(tmp_path / "run"), "row": 1},
        **{"version": __version__, "run_version": "0.0.9", "to": to, "dtype": dtype},
        "batch": 1 if to == "c" else "any",
        "inputs": [{"name": "state", "size": 2, "unit": "m", "region": "a ball"}],
        "outputs": [
            {"name": "value", "size": None, "unit": "J", "region": "V^"},
            {"name": "gradient", "size": 2, "unit": "J/m", "region": "grad V^"},
        ],
        "work": dict(zip(WORK.__dataclass_fields__, (1, 2, 3, 4, 5), strict=True)),
        **{"runtime": runtimes[to], "machine": machine()},
        "latency": {"calls": 9, "median_us": 1.0, "p99_us": 2.0, "worst_us": 3.0},
        "equality": {"value": 0.0, "gradient": 0.0},
    }
    whole = {**page, "float32_error": errors, "torch": torch.__version__}
    text = path.with_name(f"{path.name}.json").read_text()
    assert json.loads(text) == whole
    assert text.startswith('{\n  "file": ')
    assert path.with_name(f"{path.name}.md").read_text() == markdown(whole)
    assert parts.seen["timed"] == ((1, 2), 9)
    wrote = {
        "onnx": ("onnx", ["state"], ["value", "gradient"]),
        "aoti": ("package",),
        "pt2": (
            "program",
            {
                **{"version": __version__, "run": str(tmp_path / "run"), "row": 1},
                **{"input": page["inputs"][0], "outputs": ["value", "gradient"], "what": "A sentence."},
            },
        ),
        "c": (
            *("c", real, ["value", "gradient"]),
            f"A sentence.\nFrom {tmp_path / 'run'}, trajectory 1, staf_torch {__version__}.",
        ),
    }
    assert parts.seen["wrote"] == wrote[to]
    if to == "c":
        assert parts.seen["work"] == (2 + 1 + 2, real)  # the state, the value and the gradient
        assert parts.seen["runner"] == ("c", ([None, 2], real))
        assert parts.rows == [1] * 7 + [1]
    else:
        assert parts.seen["traced"] == (real, (7, 2), None)
        assert parts.seen["runner"] == ({"pt2": "program"}.get(to, wrote[to][0]), ())
        assert parts.rows == [7, 1]


def test_a_file_for_so_many_rows_is_called_with_so_many(parts: Parts, tmp_path: Path) -> None:
    page = export(tmp_path, "pt2", batch=3, calls=2, trust=True)
    assert page["batch"] == 3
    assert parts.rows == [3, 3, 3]  # compared at two whole batches of the seven points, and timed
    assert parts.seen["traced"][2] == 3
    assert parts.seen["timed"] == ((3, 2), 2)
    assert parts.seen["read"] == (tmp_path, 0, True)
    export(tmp_path, "pt2")
    assert parts.seen["timed"] == ((1, 2), 10_000)


@pytest.mark.parametrize(("dtype", "most"), [("float64", 1e-9), ("float32", 1e-3)])
def test_a_file_that_differs_too_far_from_the_library_is_removed(
    dtype: str, most: float, parts: Parts, tmp_path: Path
) -> None:
    path = tmp_path / "new" / "folder" / "it.pt2"
    parts.off = 0.9 * most
    assert export(tmp_path, "pt2", dtype=dtype, output=path)["file"] == "it.pt2"
    assert export(tmp_path, "pt2", dtype=dtype, output=path)["file"] == "it.pt2"  # written over
    for off in (1.1 * most, -1.1 * most, float("nan")):
        parts.off = off
        with pytest.raises(ValueError, match=r"it\.pt2 differs from the library by .* and was removed"):
            export(tmp_path, "pt2", dtype=dtype, output=path)
        assert not path.exists()


def test_an_error_that_is_no_number_is_not_written(parts: Parts, tmp_path: Path) -> None:
    parts.rough = float("nan")
    with pytest.raises(ValueError, match="not JSON compliant"):
        export(tmp_path, "pt2", output=tmp_path / "it.pt2")
    assert not (tmp_path / "it.pt2.json").exists()


def test_a_link_is_not_written_through_and_a_folder_that_is_named_may_be_one(
    parts: Parts, tmp_path: Path
) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "linked").symlink_to(tmp_path / "real")
    export(tmp_path, "pt2", output=tmp_path / "linked" / "it.pt2")
    assert (tmp_path / "real" / "it.pt2").read_text() == "a file"
    (tmp_path / "it.pt2").symlink_to(tmp_path / "real" / "other")
    with pytest.raises(ValueError, match=r"it\.pt2 is a link, or in a folder that is one"):
        export(tmp_path, "pt2", output=tmp_path / "it.pt2")


def test_what_a_format_needs_is_asked_before_the_run_is_read(tmp_path: Path, monkeypatch: Any) -> None:
    for to in ("onnx", "aoti", "c"):
        monkeypatch.setitem(command._NEEDS, to, lambda to=to: int(f"{to} is absent"))
        with pytest.raises(ValueError, match=f"{to} is absent"):
            export(tmp_path, to)
    with pytest.raises(ValueError, match="must be a run directory"):
        export(tmp_path, "pt2")
    monkeypatch.setattr(command.c_header, "need_c_compiler", lambda: int("no compiler"))
    with pytest.raises(ValueError, match="no compiler"):
        export_learning(tmp_path)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_learner_is_compared_over_its_steps(dtype: str, parts: Parts, tmp_path: Path) -> None:
    run, real = tmp_path / "run", getattr(torch, dtype)
    page = export_learning(run, dtype=dtype, row=2, calls=4, trust=True)
    assert (run / "export" / "learner.h.json").exists()
    assert parts.seen["read"] == (run, 2, True)
    note = f"A learner.\nFrom {run}, trajectory 2, staf_torch {__version__}."
    assert parts.seen["wrote"] == (real, (1, 2), 0.5, note)
    assert parts.seen["runner"] == ("learning_c", (2, 3, real))
    assert page["equality"]["u"] <= (1e-12 if dtype == "float64" else 1e-6)
    assert page["float32_error"]["u"] == pytest.approx(1e-3, rel=1e-3)
    assert page["latency"] == {"calls": 4, "median_us": 1.0, "p99_us": 2.0, "worst_us": 3.0}
    assert parts.called == [(7, 2, 7, 2, 2), (1, 2, 1, 2, 2)]
    assert parts.seen["work"] == (2 + 4 + 3, real)
    assert (page["to"], page["dtype"], page["batch"], page["row"]) == ("c", dtype, 1, 2)
    parts.off = 1e-2
    with pytest.raises(ValueError, match=r"learner\.h differs from the library by 0\.01 and was removed"):
        export_learning(run, dtype=dtype)
    assert parts.seen["read"] == (run, 0, False)


def test_an_input_of_a_learner_without_a_size_is_one_number(parts: Parts, tmp_path: Path) -> None:
    scalar = (Port("u", None, "N", ""),)
    parts.learner = Learner(
        *("A learner.", Adding(1), 0.5, POINTS, parts.learner.uniform, parts.learner.inputs, scalar, None)
    )
    export_learning(tmp_path, output=tmp_path / "learner.h")
    assert parts.seen["runner"] == ("learning_c", (2, 1, torch.float64))
    assert parts.seen["work"][0] == 2 + 4 + 1


def test_the_words_of_the_command_are_the_arguments_of_the_function(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(command, "export", lambda **given: seen.append(given) or given)
    monkeypatch.setattr(command, "export_learning", lambda run, **given: seen.append((run, given)) or given)
    monkeypatch.setattr(command.sheet, "markdown", lambda page: f"a page of {len(page)}\n")
    few = {"dtype": "float64", "output": None, "row": 0, "calls": 10_000, "trust": False}
    main(["a/run", "--to", "c"])
    assert seen.pop() == {"run": Path("a/run"), "to": "c", "batch": None, **few}
    assert capsys.readouterr().out == "a page of 8\n"
    assert logging.getLogger("torch.onnx._internal.exporter._registration").level == logging.ERROR
    main(["b", "--to", "c", "--learning", "--batch", "1"])
    assert seen.pop() == (Path("b"), few)
    words = "b --to onnx --dtype float32 --output o/p --row 3 --batch 4 --calls 5 --trust"
    main(words.split())
    assert seen.pop() == {
        **{"run": Path("b"), "to": "onnx", "dtype": "float32", "output": Path("o/p")},
        **{"row": 3, "batch": 4, "calls": 5, "trust": True},
    }
    for odd in (["b"], ["b", "--to", "no"], ["--to", "c"], ["b", "--to", "c", "--dtype", "half"]):
        with pytest.raises(SystemExit) as ended:
            main(odd)
        assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("usage: staf-export ")
    monkeypatch.setattr(command, "export", lambda **given: int("odd\x1b"))
    with pytest.raises(SystemExit, match=r"^staf-export: invalid literal .*: 'odd\\\\?x1b'$"):
        main(["b", "--to", "c"])
    monkeypatch.setattr(command, "export", lambda **given: Path("/nowhere").stat())
    with pytest.raises(SystemExit, match=r"^staf-export: \[Errno 2\]"):
        main(["b", "--to", "c"])


def test_the_help_of_the_command_says_what_each_word_is() -> None:
    text = " ".join(command.parser().format_help().split())
    for said in (
        "Write a run's controller (adp) or approximation (gradient_chase) for a device, with a sheet of",
        *("run directory", "the format", "file; RUN/export/... by default", "trajectory (0)"),
        *("rows of every call; any by default", "timed (10000)", "import code of your own that the settings"),
        "with --to c: the controller goes on learning, from time 0",
    ):
        assert said in text
