"""A program's gradient is that of its definition, whatever it is by, in any memory, on any threads."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor, nn

from staf_torch import lanes
from staf_torch.lanes import Shared
from staf_torch.lanes.tree import Tree, flatten, plain

pytestmark = pytest.mark.needs_compiler
ROWS, TIMES = 70, 13
GAIN, MATRIX = nn.Parameter(tensor(0.3)), nn.Parameter(tensor([[0.4, -0.2, 0.1], [0.3, 0.2, -0.5]]))


def drawn(*shape: int) -> Tensor:
    return uniform(math.prod(shape)).reshape(shape)


OWN = torch.linspace(0.5, 1.5, ROWS).double().requires_grad_()
NUMBERS = lanes.rows(OWN)


def everything(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
    """A step that reads inputs of all kinds, tensors of outside, and counts."""
    (x, count), (u, wind), (mass, push) = carry, now, row
    turned = (x @ MATRIX.mT).tanh()
    after = x + 0.1 * torch.cat((turned, u), -1) / mass.unsqueeze(-1) - GAIN * NUMBERS * x.sin() * wind
    return (after + push, count + 1), {"turned": turned, "far": x.norm(dim=-1), "count": count}


def inputs() -> tuple[Tree, Tree, Tree]:
    x, u, mass = drawn(ROWS, 3), drawn(ROWS, TIMES, 1), drawn(ROWS).abs() + 1
    wind, push = drawn(TIMES), drawn(3)
    for part in (x, u, mass, wind, push):
        part.requires_grad_()
    return (x, torch.zeros(ROWS, dtype=torch.int64)), (u, Shared(wind)), (mass, Shared(push))


EVERYTHING = lanes.Program(everything, name="everything")


def gradients(
    function: Callable[..., Tree], given: tuple[Tree, ...], *more: Tensor, **settings: Any
) -> list[Tensor]:
    found = [leaf for leaf in flatten(function(*given, **settings))[0] if leaf.is_floating_point()]
    weights = [torch.linspace(0.5, 1.0, leaf.numel()).to(leaf).view(leaf.shape) for leaf in found]
    total = sum((leaf * weight).sum() for leaf, weight in zip(found, weights, strict=True))
    by = [leaf for leaf in map(plain, flatten(given)[0]) if leaf.requires_grad]
    return [*torch.autograd.grad(total, [*by, *more])]


def close(found: list[Tensor], wanted: list[Tensor], tolerance: float = 1e-11) -> None:
    for one, other in zip(found, wanted, strict=True):
        assert one.shape == other.shape
        assert one.dtype == other.dtype
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance * float(other.abs().max()))


@pytest.mark.parametrize(("every", "mebibytes"), [(1, 256), (4, 0.02), (1, 0.001)])
def test_a_gradient_is_that_of_the_definition_by_all_that_is_read(every: int, mebibytes: float) -> None:
    given = inputs()
    wanted = gradients(EVERYTHING.definition, given, GAIN, MATRIX, OWN, every=every)
    with lanes.gradient_memory(mebibytes):
        close(gradients(EVERYTHING, given, GAIN, MATRIX, OWN, every=every), wanted)


def test_on_a_device_it_is_the_same() -> None:
    given = inputs()
    with lanes.device.host():
        found = gradients(EVERYTHING, given, GAIN, MATRIX, OWN)
    close(found, gradients(EVERYTHING, given, GAIN, MATRIX, OWN))


def test_it_has_the_same_bits_on_any_threads_and_a_nan_stays_in_its_row() -> None:
    threads, given = torch.get_num_threads(), inputs()
    first = gradients(EVERYTHING, given, GAIN, MATRIX, OWN)
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        for one, other in zip(first, gradients(EVERYTHING, given, GAIN, MATRIX, OWN), strict=True):
            assert torch.equal(one, other)
    finally:
        torch.set_num_threads(threads)
    (x, count), now, row = given
    broken = x.detach().clone()
    broken[5] = math.nan
    beside = gradients(EVERYTHING, ((broken.requires_grad_(), count), now, row))
    for one, other in zip((beside[k] for k in (0, 1, 3)), (first[k] for k in (0, 1, 3)), strict=True):
        assert torch.equal(one[6:], other[6:])
        assert torch.equal(one[:5], other[:5])
        assert one[5].isnan().any()


def test_numbers_that_are_learned_are_read_anew_and_nothing_is_traced_again() -> None:
    calls, gain = list[int](), nn.Parameter(tensor(0.5))

    def step(x: Tensor, _: Tree, __: Tree) -> tuple[Tensor, Tensor]:
        calls.append(len(x))
        return x - gain * x.sin(), x

    program, x = lanes.Program(step), drawn(4)
    optimizer, found = torch.optim.SGD([gain], 0.1), list[Tensor]()
    for _ in range(3):
        optimizer.zero_grad()
        program(x, steps=5)[1].square().mean().backward()
        found.append(gain.grad.clone())  # type: ignore[union-attr]
        count = len(calls)
        wanted = torch.autograd.grad(program.definition(x, steps=5)[1].square().mean(), gain)[0]
        torch.testing.assert_close(found[-1], wanted, rtol=1e-12, atol=1e-13)
        assert len(found) == 1 or len(calls) == count + 5  # of the definition
        calls.clear()
        optimizer.step()
    assert len({float(each) for each in found}) == 3
    late = program(x, steps=5)[1].sum()
    with torch.no_grad():
        gain.mul_(2)
    with pytest.raises(RuntimeError, match="inplace operation"):
        late.backward()


def _doubled(result: Tensor) -> None:
    result.mul_(2)


def _set_behind_autograd(result: Tensor) -> None:
    result.detach()[:, 1] = 3


@pytest.mark.parametrize(("write", "after"), [(None, True), (_doubled, False), (_set_behind_autograd, True)])
def test_a_result_that_is_the_carry_may_be_written_over_before_the_backward_pass(
    after: bool, write: Callable[[Tensor], None] | None
) -> None:
    def step(carry: Tree, u: Tensor, _: Tree) -> tuple[Tree, Tree]:
        x, unit, fading, count = carry
        new = x + 0.1 * unit * x.sin() * u * fading.cos()
        result = (new if after else x).view(-1, 2, 2)
        return (new, unit, 0.9 * fading, count + (new[:, 0] > 0)), result * 1.0

    program, u = lanes.Program(step, name="carried"), drawn(ROWS, TIMES, 1).requires_grad_()
    x, unit, fading = (drawn(ROWS, size).requires_grad_() for size in (4, 1, 1))
    carry, weight = (x, unit, fading, torch.zeros(ROWS).long()), drawn(ROWS, TIMES, 2, 2)

    def slopes(function: Callable[..., Tree]) -> list[Tensor]:
        (end, *_), history = function(carry, u)
        total = (weight * history).sum() + end.sum()
        if write is not None:
            write(history)
        return [*torch.autograd.grad(total, [*carry[:3], u])]

    wanted = slopes(program.definition)
    for unasked in (0, 0, 0, 20):  # the first builds the adjoint, the next keep, the last does not
        for _ in range(unasked):
            program(carry, u)
        close(slopes(program), wanted)


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")  # of torch's forward mode
def test_derivatives_of_derivatives_and_transforms_are_those_of_the_definition(
    caplog: pytest.LogCaptureFixture,
) -> None:
    (x, count), now, row = inputs()

    def twice(function: Callable[..., Tree]) -> Tensor:
        energy = function((x, count), now, row)[0][0].square().sum()
        (slope,) = torch.autograd.grad(energy, x, create_graph=True)
        return torch.autograd.grad(slope.square().sum(), MATRIX)[0]

    torch.testing.assert_close(twice(EVERYTHING), twice(EVERYTHING.definition), rtol=1e-10, atol=1e-10)
    assert "a derivative of a derivative is wanted" in caplog.text
    pushed = functools.partial(EVERYTHING, now=now, row=row)
    energy = lambda at: pushed((at, count))[0][0].square().sum()  # noqa: E731
    (slope,), at = torch.autograd.grad(energy(x), x), x.detach()
    assert "vmap, jacrev" not in caplog.text
    torch.testing.assert_close(torch.func.grad(energy)(at), slope)
    assert "everything runs in plain torch, slower: a transform of `torch.func` (vmap, jacrev" in caplog.text
    torch.testing.assert_close(torch.func.jacrev(energy)(at), slope)
    along = torch.ones_like(at)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(at, along)
        torch.testing.assert_close(torch.autograd.forward_ad.unpack_dual(energy(dual)).tangent, slope.sum())
    both = torch.func.vmap(energy)(torch.stack((at, 2 * at)))
    torch.testing.assert_close(both, torch.stack((energy(at), energy(2 * at))))
    assert caplog.text.count("runs in plain torch") == 2  # a line for each reason


def corners(x: Tensor, u: Tensor, _: Tree) -> tuple[Tensor, Tree]:
    """What has no derivative everywhere: as torch has it, ties and corners too."""
    x = torch.where(x > 0, x * u, x - u).clamp(-1.5, 1.5)
    far, near = torch.maximum(x, u), torch.minimum(x.abs(), u)
    return far - near, (x.amax(-1), torch.relu(x), (x * x).sum(-1).sqrt(), x.sort(-1).values)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_corners_and_ties_are_torchs(dtype: torch.dtype) -> None:
    x = tensor([[0.0, 0.0, 1.5], [1.0, 1.0, 1.0], [-2.0, 0.5, 0.5], [0.3, -0.7, 0.2]]).to(dtype)
    u = tensor([[[0.0, 1.0, 0.5], [1.0, 1.0, 1.0]]]).to(dtype).repeat(4, 1, 1)
    given = x.requires_grad_(), u.requires_grad_()
    program = lanes.Program(corners)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    found, wanted = gradients(program, given), gradients(program.definition, given)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance, equal_nan=True)


@pytest.mark.parametrize(("rows", "times"), [(3, 33), (70, 5)])
def test_a_parameter_in_float64_that_a_step_in_float32_reads_has_its_gradient(rows: int, times: int) -> None:
    """The adjoint is in float64 then, and its carry in float32: it wrote beyond the memory of its results."""
    gain = nn.Parameter(tensor(0.7))

    def pair(carry: tuple[Tensor, Tensor], _: Tree, __: Tree) -> tuple[Tree, Tensor]:
        a, b = carry
        late = 0.9 * a + 0.05 * gain * b.sum((1, 2)).tanh()
        return (late, 0.9 * b + 0.05 * gain * a.tanh().reshape(-1, 1, 1)), (a * late).exp().clamp(max=3)

    program = lanes.Program(pair)
    given = [uniform(rows, *shape).float().requires_grad_() for shape in ((), (2, 3))]
    for _ in range(2):  # the carry is computed again, and kept
        found = []
        for call in (program, program.definition):
            (a, b), out = call(tuple(given), steps=times)
            found.append(torch.autograd.grad(a.sum() + b.sum() + out.square().sum(), [*given, gain]))
        for one, other in zip(*found, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


LARGE, FEW = nn.Parameter(0.3 * drawn(12, 12)), nn.Parameter(drawn(5, 12))


def loops(x: Tensor, _: Tree, __: Tree) -> tuple[Tensor, Tensor]:
    """Loops that stay loops, one in another, with arrays and numbers of outside; a captured factor."""
    x = lanes.repeat(4, lambda y: y - 0.1 * GAIN * (y @ LARGE.mT), x, where=lambda y: y[:, 0] < 0.5)
    _, found = lanes.scan(lambda s, p: (0.9 * s + p.sin(), s * p), x, x.unsqueeze(1) + FEW)
    gram = (-(MATRIX.mT.unsqueeze(1) - MATRIX.mT).square().sum(-1)).exp() + torch.eye(3, dtype=x.dtype)
    weights = torch.cholesky_solve(x[:, :3].unsqueeze(-1), torch.linalg.cholesky(gram)).squeeze(-1)
    inner = lanes.repeat(
        2, lambda y: y + 0.1 * lanes.repeat(2, lambda z: z.cos() * GAIN + weights, y), weights
    )
    return 0.5 * x + 0.01 * found.sum(1) + inner.sum(-1, keepdim=True), inner


def cut(x: Tensor, _: Tree, __: Tree) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        held = x.sin() * GAIN
    return GAIN * x + held, x.detach() * MATRIX[0, 0] + (x[:, :2] @ MATRIX).clamp(0.0, 0.3).sum(
        -1, keepdim=True
    )


def solved(x: Tensor, _: Tree, __: Tree) -> tuple[Tensor, Tensor]:
    """Solutions of a row's own equations and normed layers, whose derivatives torch keeps for itself."""
    matrix = 3 * torch.eye(3, dtype=x.dtype) + (MATRIX.mT @ MATRIX) * x[:, :3].unsqueeze(-1)
    found = torch.linalg.solve(matrix, x[:, 3:6].unsqueeze(-1)).squeeze(-1)
    other = torch.linalg.solve(matrix.mT, x[:, 6:].view(-1, 2, 3), left=False).sum(-2)
    normed = torch.nn.functional.layer_norm(x, (12,), LARGE[0])
    return GAIN * x.sin() + 0.1 * normed, found * other


@pytest.mark.parametrize("step", [loops, cut, solved])
def test_loops_and_what_is_cut_have_the_gradients_of_the_definition(
    step: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    program, x = lanes.Program(step), drawn(5, 12).requires_grad_()
    with torch.no_grad():
        x[3] = math.nan
    more = [GAIN, MATRIX, *{loops: [LARGE, FEW], cut: [], solved: [LARGE]}[step]]
    given = x, (), ()
    found, wanted = (gradients(run, given, *more, steps=3) for run in (program, program.definition))
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12, equal_nan=True)
    x.data[3] = 0.0
    close(*(gradients(run, given, *more, steps=3) for run in (program, program.definition)), tolerance=1e-10)
    assert "plain torch" not in caplog.text


GRAM, SCALE = nn.Parameter(0.05 * drawn(15, 15)), nn.Parameter(1 + 0.1 * drawn(15))


def descent(weights: Tensor, target: Tensor, _: Tree) -> tuple[Tensor, Tensor]:
    """Steepest descents, in one pass as in a chase of 15 centers, of which each pass squares and divides."""

    def passed(given: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        found, slope = given
        image = slope + SCALE * (((SCALE * slope) @ GRAM.mT).sin() - (slope @ GRAM).cos())
        length = 0.1 / (1.0 + slope.square().sum(-1) + (slope * image).square().sum(-1))
        return found + 0.5 * length.unsqueeze(-1) * slope, slope - length.unsqueeze(-1) * image

    start = target.repeat(1, 5) - weights - SCALE * (weights @ GRAM.mT)
    after = lanes.repeat(10, passed, (weights, start))[0]
    return 0.3 * after, after.square()


DESCENT = lanes.Program(descent)


@pytest.mark.parametrize(("rows", "times"), [(1, 11), (70, 3)])
def test_long_steps_and_inputs_of_times_in_any_layout(rows: int, times: int) -> None:
    dense, weights = drawn(rows, times, 3).requires_grad_(), drawn(rows, 15).requires_grad_()
    apart = drawn(rows, 3, times).mT.detach().requires_grad_()
    for target in (dense, apart, dense[:, ::2]):
        given = weights, target, ()
        found = gradients(DESCENT, given, GRAM, SCALE)
        close(found, gradients(DESCENT.definition, given, GRAM, SCALE), tolerance=1e-10)


def test_a_gradient_that_rounding_has_overgrown_names_its_first_row_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    slope = torch.tensor(4.0, dtype=torch.float64, requires_grad=True)
    program = lanes.Program(lambda x, now, row: (slope * x * (1 - x), x), name="a chaotic map")
    for steps, by_state, messages in ((20, True, 0), (100, False, 1), (100, True, 1)):
        x0 = torch.tensor([0.5, math.nan, 0.3, 0.6], dtype=torch.float64, requires_grad=by_state)
        program(x0, steps=steps)[0].sum().backward()
        assert [text.partition(", ")[0][-21:] for text in caplog.messages] == [
            "by its carry in row 2"
        ] * messages
