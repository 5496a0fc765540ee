"""One step of the definition of a bank, from states of every age, against the same step of compiled code."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, inf, nan

from staf_torch.centers import simplex
from staf_torch.kernels import GaussianKernel
from staf_torch.online import bank_definition
from staf_torch.online.bank import Bank
from staf_torch.online.bank_definition import BankDefinition
from staf_torch.online.bank_rules import (
    FADING,
    PLAIN,
    RECENT,
    TRACKERS,
    TURNED,
    TURNED_FADING,
    BankShape,
    Rules,
    size,
)
from staf_torch.online.learned_trackers import Choice, Learned, Stretch
from staf_torch.online.local_functions import LocalFunctions
from staf_torch.online.quadratic_models import quadratic_features

BUT = ("asked", "gap")  # where nobody asked, two kinds of nothing; distances that are equal to the last bit
INVERSES = ("tracker_inverse", "tracker_known", "tracker_weights")  # entries of up to 1e6, which cancel


def events(outputs: int, away: int) -> tuple[Tensor, Tensor]:
    """A stream with gaps, infinities, outliers alone and in pairs, that goes elsewhere for good."""
    draw = torch.Generator().manual_seed(0)
    x = 0.3 + 2 * torch.randn(150, 1, 2, generator=draw, dtype=torch.float64)
    y = torch.stack([(x[..., 0] * (k + 1)).sin() + x[..., 1] + 3 * k for k in range(outputs)], -1)
    y = y + 0.1 * torch.randn(y.shape, generator=draw, dtype=torch.float64)
    x[12, 0, 1], y[14, 0, 0], x[16, 0, 0] = nan, nan, inf
    y[:3, 0, 1:] = nan  # measured later
    y[60], y[62], x[64, 0, 1] = 1e300, 200.0, 1e12
    y[70], y[75:77], y[80] = 40.0, -40.0, 25.0  # one that waits in vain, and two that are learned
    x[away:] += 1e9
    return x, y


YOUNG = (*range(6), 12, 14)
OLD = (60, 62, 63, 71, 75, 76, 77)
GONE = (90, 96, 97, 99)
CASES = {
    "units of its own, two outputs": (2, True, 8.0, 90, (*YOUNG, *OLD, *GONE)),
    "units that are given, one output": (1, False, None, 150, (*YOUNG[:5], 16, *OLD[3:], 135)),
}


@pytest.mark.needs_compiler
@pytest.mark.parametrize("name", CASES)
def test_a_step_of_the_definition_is_that_of_compiled_code(name: str) -> None:
    outputs, scaling, doubtful, away, looked_at = CASES[name]
    shape = BankShape(2, outputs, 128, 8)
    fast = Bank(shape, 1, scaling, doubtful)
    slow = Bank(shape, 1, scaling, doubtful)
    slow._run = None
    x, y = events(outputs, away)
    for k in range(looked_at[-1] + 1):
        lapse = torch.tensor([0.3 + 0.2 * (k % 7)], dtype=torch.float64) if k % 3 else None
        slow.table.copy_(fast.table)
        for bank in (fast, slow) if k in looked_at else (fast,):
            if k % 5 and k != 16:  # else it asks itself
                bank.predict(x[k])
            bank.learn(x[k], y[k], lapse)
        if k in looked_at:
            found, wanted = (bank._definition.each(bank.table)[0] for bank in (slow, fast))
            for part, value in wanted.items():
                if part not in BUT:
                    size_of = 1e-3 * float(value.abs().max()) if part in INVERSES else 0.0
                    torch.testing.assert_close(
                        found[part],
                        value,
                        rtol=1e-5,
                        atol=1e-6 + size_of,
                        equal_nan=True,
                        msg=lambda told, part=part, k=k: f"{part} {k}: {told}",
                    )


@pytest.mark.parametrize("spread", [1e-3, 1.0, 50.0])
def test_what_is_beyond_is_so_many_spreads_away(spread: float) -> None:
    shape, functions = BankShape(2, 1, 128, 8), LocalFunctions.of(GaussianKernel(1.0), simplex(2))
    definition = BankDefinition(shape, Rules.of(2, True), functions)
    (s,) = definition.each(torch.zeros(1, size(shape), dtype=torch.float64))
    definition.clear(s)
    s["spread"].copy_(torch.tensor([spread, 2 * spread, 3 * spread]))
    s["center"].copy_(torch.tensor([1.0, 2.0, 3.0]))
    for k in range(3):
        for share, clock, beyond in ((1.001, 40, True), (0.999, 40, False), (1.001, 39, False)):
            s["clock"].fill_(clock)
            both = s["center"].clone()
            both[k] -= share * definition.rules.far * float(s["spread"][k])
            assert definition._beyond(s, both[:2], both[2:]) is beyond


@pytest.mark.parametrize("scaling", [False, True])
def test_a_store_gives_up_the_older_of_the_closest_pair_of_those_that_are_not_recent(scaling: bool) -> None:
    """Against a search of all pairs; steps on a grid, so that some distances are equal."""
    shape = BankShape(2, 1, RECENT + 6, 8)
    functions = LocalFunctions.of(GaussianKernel(1.0), simplex(2))
    definition = BankDefinition(shape, Rules.of(2, scaling), functions)
    (s,) = definition.each(torch.zeros(1, size(shape), dtype=torch.float64))
    definition.clear(s)
    s["spread"].copy_(torch.tensor([1.0, 4.0, 1.0]))
    unit = torch.tensor([1.0, 4.0 if scaling else 1.0], dtype=torch.float64)
    draw = torch.Generator().manual_seed(1)
    x = torch.randint(0, 12, (RECENT + 40, 2), generator=draw).double()
    kept: list[int] = []  # clocks of the samples, from 1
    for clock in range(1, len(x) + 1):
        old = [each for each in kept if each <= clock - RECENT]
        if len(kept) == shape.capacity:
            apart = torch.cdist(x[[each - 1 for each in old]] / unit, x[[each - 1 for each in old]] / unit)
            apart.fill_diagonal_(inf)
            closest = apart.amin(1)
            kept.remove(min(each for each, a in zip(old, closest, strict=True) if a <= closest.min() + 1e-9))
        kept.append(clock)
        s["clock"].fill_(float(clock))
        definition._keep(s, x[clock - 1], torch.full((1,), float(clock)).double(), 0.5 * clock)
        assert float(s["count"]) == len(kept)
        order = s["order"][: len(kept)]
        assert sorted(order.tolist()) == kept
        at = order.long() - 1
        assert torch.equal(s["x"][: len(kept)], x[at])
        assert torch.equal(s["y"][: len(kept), 0], order)
        assert torch.equal(s["when"][: len(kept)], 0.5 * order)
        among = order <= clock + 1 - RECENT  # what is next to choose from
        apart = torch.where(among[:, None] & among, torch.cdist(x[at] / unit, x[at] / unit), inf)
        apart.fill_diagonal_(inf)
        torch.testing.assert_close(s["gap"][: len(kept)], apart.amin(1).square())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_features_are_products_squares_or_the_coordinates_alone(dtype: torch.dtype) -> None:
    u = torch.tensor([2.0, -3.0, 5.0], dtype=dtype)
    for values, count, wanted in (
        (u[:1], 3, [1, 2, 4]),
        (u[:2], 6, [1, 2, -3, 4, -6, 9]),
        (u, 10, [1, 2, -3, 5, 4, -6, 10, 9, -15, 25]),
        (u, 7, [1, 2, -3, 5, 4, 9, 25]),
        (u, 4, [1, 2, -3, 5]),
    ):
        found = quadratic_features(values, count)
        assert found.tolist() == wanted
        assert found.dtype == dtype


@pytest.mark.parametrize("kind", ["definition", pytest.param("compiled", marks=pytest.mark.needs_compiler)])
def test_a_stream_that_goes_where_nothing_can_be_learned_waits_there(kind: str) -> None:
    """Beyond 1e150 a sample is never kept: the eighth ends what was known, and a usual one begins."""
    bank = Bank(BankShape(2, 1, 128, 8), 1, True)
    if kind == "definition":
        bank._run = None
    x, y = events(1, 150)
    for k in range(5):
        bank.learn(x[k], y[k])
    (stream,) = bank._definition.each(bank.table)
    for k in range(10):
        assert float(stream["count"]) == (5 if k < 8 else 0)
        assert float(stream["far"]) == min(k, 8)
        bank.learn(x[5], torch.full_like(y[5], 1e200))
    assert float(stream["skipped"]) == 10
    assert float(stream["learned"]) == 5
    assert bank.predict(x[6])[0].tolist() == [[0.0]]
    for k in range(6, 9):
        bank.learn(x[k], y[k])
    assert float(stream["far"]) == 0
    assert (float(stream["count"]), float(stream["clock"])) == (3, 3)
    assert (float(stream["learned"]), float(stream["skipped"])) == (8, 10)
    assert float(stream["time"]) == 18


def test_trackers_learn_from_the_latest_samples_that_are_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    shape, given = BankShape(2, 1, 200, 8), []
    choices = [Choice(1.0 + k, 0.1 + k, 0.01 * (k + 1), 0.0) for k in range(4)]
    metric = torch.tensor([[1.0, 0.0], [0.5, 2.0]], dtype=torch.float64)

    def learned(s: Stretch) -> Learned:
        given.append(s)
        return Learned(*choices, metric)

    monkeypatch.setattr(bank_definition, "learn_hyperparameters", learned)
    functions = LocalFunctions.of(GaussianKernel(1.0), simplex(2))
    definition = BankDefinition(shape, Rules.of(2, True), functions)
    (s,) = definition.each(torch.zeros(1, size(shape), dtype=torch.float64))
    definition.clear(s)
    before = {name: s[f"tracker_{name}"].clone() for name in ("rate", "noise", "forgetting")}
    draw = torch.Generator().manual_seed(3)
    x, y = (torch.randn(160, n, generator=draw, dtype=torch.float64) for n in (2, 1))
    x[20, 0], y[140] = 3e3, 1e200  # two that are not believed
    units = torch.tensor([1.0, -1.0, 5.0, 0.5, 2.0, 4.0], dtype=torch.float64)
    s["center"].copy_(units[:3])
    s["spread"].copy_(units[3:])
    x[150] = torch.tensor([1.0 + 0.5 * 999, -1.0])  # and one that just is
    s["x"][:160], s["y"][:160], s["when"][:160] = x, y, 0.5 * torch.arange(160, dtype=torch.float64)
    for clock in (160.0, 40.0):
        s["clock"].fill_(clock)
        definition._learn_trackers(s, 160)
        (stretch,) = given
        usable = [k for k in range(160) if k not in (20, 140)][-128:]
        torch.testing.assert_close(stretch.at, (x[usable] - units[:2]) / units[3:5])
        torch.testing.assert_close(stretch.y, (y[usable] - units[2]) / units[5])
        assert torch.equal(stretch.when, 0.5 * torch.tensor(usable, dtype=torch.float64))
        given.clear()
    assert torch.equal(s["metric"], metric)
    lanes = {TURNED: choices[0], PLAIN: choices[1], FADING: choices[2], TURNED_FADING: choices[3]}
    for lane in range(TRACKERS):
        found = [float(s[f"tracker_{name}"][lane]) for name in before]
        if lane in lanes:
            rate, noise, fade, _ = lanes[lane]
            assert found == pytest.approx([rate, noise, math.exp(-2 * fade)])
        else:
            assert found == [float(each[lane]) for each in before.values()]
