"""The mixture: a bank of local models over remembered samples."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers_streams import REGRESSORS, mixture
from torch import Tensor, inf, nan
from variants import over

from staf_torch.online.mixture.regressor import Bank
from staf_torch.online.mixture.rules import RECENT, BankShape, layout


def streams(steps: int, count: int, outputs: int = 1, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Inputs that come back, a function with a little noise: (T, S, 2), (T, S, K)."""
    draw = torch.Generator().manual_seed(seed)
    x = torch.randn(steps, count, 2, generator=draw, dtype=torch.float64)
    y = torch.stack([(x[..., 0] * (k + 1)).sin() + x[..., 1] for k in range(outputs)], -1)
    return x, y + 0.1 * torch.randn(y.shape, generator=draw, dtype=torch.float64)


@pytest.mark.needs_compiler
def test_streams_have_the_same_bits_alone_and_beside_others() -> None:
    x, y = streams(135, 5)
    y[40, 1], x[60, 3] = torch.nan, 1e250
    together = mixture().fit(x, y[..., 0])
    for i in (1, 3):
        alone = mixture().fit(x[:, i], y[:, i, 0])
        assert torch.equal(together.predict(x[0])[i], alone.predict(x[0, i]))


def test_size_does_not_grow_with_the_stream() -> None:
    x, y = streams(140, 1)
    model = mixture().fit(x[:2], y[:2, :, 0])
    before = model.state_dict()["table"].numel()
    for state, value in zip(x[2:], y[2:, :, 0], strict=True):
        model.partial_fit(state, value)
    assert model.state_dict()["table"].numel() == before


@over(REGRESSORS, "kind")
def test_saved_state_goes_on_bit_for_bit(kind: str, tmp_path: object) -> None:
    x, y = streams(50, 3, outputs=2)
    whole = REGRESSORS[kind](scaling=True)
    again = REGRESSORS[kind](scaling=True)
    for k in range(30):
        whole.partial_fit(x[k], y[k])
    torch.save(whole.state_dict(), f"{tmp_path}/state.pt")
    again.load_state_dict(torch.load(f"{tmp_path}/state.pt", weights_only=True))
    for k in range(30, 50):
        whole.partial_fit(x[k], y[k])
        again.partial_fit(x[k], y[k])
    assert torch.equal(whole.predict(x[0]), again.predict(x[0]))


@over(REGRESSORS, "kind")
def test_no_saved_state_leads_compiled_code_outside(kind: str) -> None:
    x, y = streams(5, 2)
    fitted = REGRESSORS[kind]().fit(x, y[..., 0])
    for name, tensor in fitted.state_dict().items():
        if isinstance(tensor, Tensor) and name != "first":
            for other in (tensor[..., :-1], tensor.float() if tensor.is_floating_point() else tensor.int()):
                with pytest.raises(ValueError, match=r"load_state_dict.*must have"):
                    REGRESSORS[kind]().load_state_dict(fitted.state_dict() | {name: other})


@pytest.mark.parametrize(
    ("name", "value", "rule"),
    [
        ("count", 129.0, "a number of samples from 0 to 128"),
        ("count", torch.nan, "a number of samples"),
        ("tracker_counts", 97.0, "a place from 0 to 96"),
        ("tracker_counts", -1.0, "a place"),
        ("y", torch.inf, "samples that are finite"),
    ],
)
def test_a_saved_bank_with_numbers_that_no_bank_writes_is_refused(name: str, value: float, rule: str) -> None:
    bank = Bank(BankShape(2, 1, 128, 8), 3, True)
    table = bank.table.clone()
    bank.definition.each(table, bank.answers)[1][name].view(-1)[-1:] = value
    with pytest.raises(ValueError, match=rf"load_state_dict.*must have {rule}"):
        bank.load_state_dict({"table": table})


@pytest.mark.needs_compiler
@over(REGRESSORS, "kind")
def test_streams_come_and_go_without_touching_the_others(kind: str) -> None:
    x, y = streams(80, 4)
    model = REGRESSORS[kind]()
    alone = REGRESSORS[kind]()
    for k in range(40):
        model.partial_fit(x[k, :3], y[k, :3, 0])
        alone.partial_fit(x[k, 2], y[k, 2, 0])
    with pytest.raises(ValueError, match="numbers of streams"):
        model.drop(torch.tensor([True, False]))  # not a mask
    model.drop([]).drop([0]).add(2).reset(streams=[0])
    assert model.n_streams_ == 4
    assert model.n_samples_seen_.tolist()[1:] == [40, 0, 0]
    fresh = REGRESSORS[kind]()
    for k in range(40, 80):
        model.partial_fit(x[k, [1, 2, 3, 0]], y[k, [1, 2, 3, 0], 0])
        alone.partial_fit(x[k, 2], y[k, 2, 0])
        fresh.partial_fit(x[k, 1], y[k, 1, 0])
    found = model.predict(x[0, [1, 2, 3, 0]])
    assert torch.equal(found[1], alone.predict(x[0, 2]))
    assert torch.equal(found[0], fresh.predict(x[0, 1]))


def test_no_streams_have_no_predictions() -> None:
    shape, x = BankShape(2, 1, 128, 8), torch.zeros(0, 2, dtype=torch.float64)
    for bank in (Bank(shape, 0, True), Bank(shape, 0, True, compile=False)):
        bank.learn(x, x[:, :1])
        assert [part.shape for part in bank.predict(x)] == [(0, 1), (0, 1)]


def test_a_sample_with_nothing_to_learn_is_skipped_and_does_no_harm() -> None:
    """An input that is infinite or was not measured at all, a target that is infinite or not there."""
    given = [[0.5, inf], [nan, nan], [0.5, 0.5], [0.5, 0.5], [0.5, 0.5]]
    told = [[nan, 1.0], [nan, 1.0], [1.0, -inf], [nan, nan], [nan, 1.0]]
    bank = Bank(BankShape(2, 2, 128, 8), 5, True)
    x, y = streams(4, 5, outputs=2)
    for state, value in zip(x, y, strict=True):
        bank.learn(state, value)
    bank.learn(torch.tensor(given).double(), torch.tensor(told).double())
    assert bank.learned.tolist() == [4, 4, 4, 4, 5]
    assert bank.skipped.tolist() == [1, 1, 1, 1, 0]
    assert all(torch.isfinite(part).all() for part in bank.predict(x[1]))


@pytest.mark.needs_compiler
def test_output_that_is_measured_later_was_not_0_before() -> None:
    """Streams whose second output, far from 0, is measured from the first, second or eighth sample on."""
    x, y = (part.expand(-1, 3, -1) for part in streams(120, 1, 2))
    whole = y + torch.tensor([50.0, -2000.0]).double()
    told, errors, bank = whole.clone(), [], Bank(BankShape(2, 2, 128, 8), 3, True)
    told[:1, 1, 1], told[:7, 2, 1] = nan, nan
    for k in range(120):
        if k >= 19:
            errors.append(bank.predict(x[k].contiguous())[0][:, 1] - whole[k, :, 1])
        bank.learn(x[k].contiguous(), told[k])
    first, second, eighth = torch.stack(errors).square().mean(0).sqrt().tolist()
    assert max(second, eighth) < 2.5 * first  # 4 and more where it was 0


BUT = ("gap",)  # distances that are equal to the last bit
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
    slow = Bank(shape, 1, scaling, doubtful, compile=False)
    x, y = events(outputs, away)
    for k in range(looked_at[-1] + 1):
        lapse = torch.tensor([0.3 + 0.2 * (k % 7)], dtype=torch.float64) if k % 3 else None
        slow.table.copy_(fast.table)
        slow.answers.copy_(fast.answers)
        for bank in (fast, slow) if k in looked_at else (fast,):
            if k % 5 and k != 16:  # else it asks itself
                bank.predict(x[k])
            bank.learn(x[k], y[k], lapse)
        if k in looked_at:
            found, wanted = (bank.definition.each(bank.table, bank.answers)[0] for bank in (slow, fast))
            for part, value in ((part, wanted[part]) for part, _ in layout(shape)):
                if part not in BUT:
                    size_of = 1e-3 * float(value.abs().max()) if part in INVERSES else 0.0
                    near: Any = {"rtol": 1e-5, "atol": 1e-6 + size_of, "equal_nan": True}
                    torch.testing.assert_close(found[part], value, **near)


def test_a_stream_that_goes_where_nothing_can_be_learned_waits_there() -> None:
    """Beyond 1e150 a sample is never kept: the eighth ends what was known, and a usual one begins."""
    bank = Bank(BankShape(2, 1, 128, 8), 1, True)
    x, y = events(1, 150)
    for k in range(5):
        bank.learn(x[k], y[k])
    (stream,) = bank.definition.each(bank.table, bank.answers)
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


@pytest.mark.needs_compiler
def test_a_store_gives_up_the_older_of_the_closest_pair_of_those_that_are_not_recent() -> None:
    """Against a search of all pairs; samples on a grid, so that some distances are equal."""
    bank, draw = Bank(BankShape(2, 1, 128, 8), 1, False), torch.Generator().manual_seed(1)
    x = torch.randint(0, 12, (168, 2), generator=draw).double()
    kept: list[int] = []  # numbers of the samples
    for k in range(len(x)):
        if len(kept) == 128:
            old = [each for each in kept if each < k + 1 - RECENT]
            apart = torch.cdist(x[old], x[old])
            apart.fill_diagonal_(inf)
            closest = apart.amin(1)
            kept.remove(min(each for each, a in zip(old, closest, strict=True) if a <= closest.min() + 1e-9))
        kept.append(k)
        bank.learn(x[k : k + 1], torch.full((1, 1), 1e-3 * k).double())
        (stream,) = bank.definition.each(bank.table, bank.answers)
        found = stream["order"][: len(kept)].long() - 1
        assert sorted(found.tolist()) == kept
        assert torch.equal(stream["x"][: len(kept)], x[found])


def test_what_a_function_that_saturates_takes_is_mapped_and_other_functions_are_left() -> None:
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(350, 1, 2, generator=draw, dtype=torch.float64)
    seen = x.sum(-1, keepdim=True) + 0.1 * torch.randn(350, 1, 1, generator=draw, dtype=torch.float64)
    errors = {}
    for name, y in (("saturates", (5 * seen).tanh()), ("does not", seen)):
        bank, found = Bank(BankShape(2, 1, 128, 8), 1, True), []
        for k in range(350):
            bank.predict(x[k])
            stream = bank.definition.each(bank.table, bank.answers)[0]
            value = (y[k, 0] - stream["center"][2:]) / stream["spread"][2:]
            found.append(torch.stack((stream["blend"][:, -1], stream["straight"], stream["mean"])) - value)
            bank.learn(x[k], y[k])
        errors[name] = torch.stack(found[150:]).square().mean(0).sqrt()[:, 0]
    mapped, straight, mean = errors["saturates"]
    assert mapped < 0.85 * straight
    assert mean < 0.95 * straight
    _, straight, mean = errors["does not"]
    assert mean < 1.01 * straight
