"""Mutants that change nothing that anybody could see: kinds of them, and each by its name."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from mutants import Mutant

_DEVICE = "of another device than the processor, which machines that run the tests lack"
_ENCODING = "of a locale other than UTF-8, which machines that run the tests lack"
_LOOKS = "how a line of a figure is drawn, not where"
_STYLE = (
    "marker",
    "markersize",
    "alpha",
    "linewidth",
    "zorder",
    "fontsize",
    "handlelength",
    "frameon",
    "rotation",
    "size",
    "ncols",
    "borderaxespad",
    "length",
    "columnspacing",
    "handletextpad",
)
_SPEED = "decides which of two ways that find the same is taken: the threshold is of speed alone"
_EDGE = (
    "a number that equals a tolerance (below 1e-3, or above 1e100) to the last bit: none does but by chance"
)
_LENGTHS = "an assertion of our own that lengths agree; other assertions are no mutants either"
_TOLERANCE, _HUGE = 1e-3, 1e100
_LIMIT = "a limit that is chosen, of a hundred or more, by one"
_SIZE = "the size of a page of figures"
_ONES = "zeros and ones, which are exact in every dtype, and meet numbers of float64"
_DIGITS = "how many digits a table or a log shows"
_ROWS = "of (B, n), the one shape that comes there"
_TIE = "of two that are equal to the last bit either is right"
_EDGES = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_ROOT = Path(__file__).resolve().parent.parent


def accepted(mutant: Mutant) -> str | None:
    """Why a mutant changes nothing that anybody could see; None where it does."""
    if _at_a_tolerance(mutant):
        return _EDGE
    if _of_lengths(mutant):
        return _LENGTHS
    if mutant.was.startswith("zip(") and "strict=False" in mutant.was and _without(mutant, "strict"):
        return "which is the default"
    if re.match(r"work = [0-9.]+$", _code(mutant)) and _is_number(mutant.was):
        return _SPEED
    if _without(mutant, "device"):
        return _DEVICE
    if _without(mutant, "encoding"):
        return _ENCODING
    if mutant.room == "figures" and any(_without(mutant, name) or _of(mutant, name) for name in _STYLE):
        return _LOOKS
    if mutant.was.startswith("torch.eye(") and _without(mutant, "dtype"):
        return _ONES
    if re.match(r"(Program|RowFunction)\(", mutant.was) and _without(mutant, "name"):
        return "a name in messages"
    if mutant.room == "figures" and f"colour({mutant.was})" in mutant.context:
        return "which of our colours"
    if _is_number(mutant.was) and f"stacklevel={mutant.was}" in mutant.context:
        return "the line that a warning names"
    if mutant.file == "staf_torch/lanes/cuda.py":
        return _DEVICE
    if _of_a_limit(mutant):
        return _LIMIT
    if mutant.room == "figures" and re.search(r"\bpage\(", mutant.context) and re.search(r"\d", mutant.was):
        return _SIZE
    return ACCEPTED.get(mutant.key)


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[0-9.]+", text) is not None


def _of_a_limit(mutant: Mutant) -> bool:
    """Whether a whole number of at least a hundred, a named one or of passes, has become the next one."""
    named = re.match(
        rf"_?[A-Z][A-Z_, ]* = [^\"']*$|for \w+ in range\({re.escape(mutant.was)}\):", _code(mutant)
    )
    numbers = mutant.was.replace("_", ""), mutant.now.replace("_", "")
    if named is None or not all(each.isdecimal() for each in numbers):
        return False
    was, now = map(int, numbers)
    return was >= 100 and now == was + 1


def _code(mutant: Mutant) -> str:
    return mutant.context.split("#")[0].strip()


def _without(mutant: Mutant, name: str) -> bool:
    """Whether all that a mutant changes is that a call lacks an argument of that name."""
    fewer = re.sub(rf",?\s*\b{name}=[^,()]*(\([^()]*\))?[^,()]*(?=[,)])", "", mutant.was, count=1)
    return fewer != mutant.was and _plain(fewer) == _plain(mutant.now)


def _of(mutant: Mutant, name: str) -> bool:
    """Whether a mutant changes the number of an argument of that name."""
    stated = f"{name}={mutant.was}", f'"{name}": {mutant.was}'
    return _is_number(mutant.was) and any(each in mutant.context for each in stated)


def _of_lengths(mutant: Mutant) -> bool:
    """Whether all that a mutant changes is that `zip` does not see whether lengths agree."""
    if mutant.was == "True":
        return (
            "strict=True" in mutant.context and "zip(" in mutant.context and mutant.context.count("True") == 1
        )
    return mutant.was.startswith("zip(") and "strict=True" in mutant.was and _without(mutant, "strict")


def _at_a_tolerance(mutant: Mutant) -> bool:
    """Whether all that a mutant changes is on which side of a small tolerance an equal number falls."""
    try:
        was, now = (ast.parse(text.strip(), mode="eval").body for text in (mutant.was, mutant.now))
    except SyntaxError:
        return False
    if not isinstance(was, ast.Compare) or not isinstance(now, ast.Compare) or len(was.ops) != 1:
        return False
    if _EDGES.get(type(was.ops[0])) is not type(now.ops[0]):
        return False
    numbers = [_number(mutant.file, side) for side in (was.left, was.comparators[0])]
    return any(0 < number < _TOLERANCE or number > _HUGE for number in numbers)


def _number(file: str, node: ast.expr) -> float:
    """The value of a number, or of a constant of the file by its name; 0 for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, float):
        return node.value
    if isinstance(node, ast.Name) and node.id.isupper():
        text = (_ROOT / file).read_text(encoding="utf-8") if (_ROOT / file).exists() else ""
        found = re.search(rf"^{node.id} = ([0-9.]+e-[0-9]+)\b", text, re.MULTILINE)
        return float(found[1]) if found else 0.0
    return 0.0


def _plain(text: str) -> str:
    """Without blanks, kinds of quotes and a last comma."""
    return re.sub(r",(?=\))", "", re.sub(r"\s", "", text)).replace('"', "'")


# (file, line, what changes, into what) -> why
ACCEPTED: dict[tuple[str, str, str, str], str] = {
    (
        "staf_torch/adp/traced_search.py",
        "gain = (cost - best) / cost.abs().clamp(min=1e-300)",
        "cost - best",
        "(cost + best)",
    ): _SPEED,
    ("staf_torch/lanes/graph.py", "if right == -1:", "-1", "(1)"): _SPEED,
    (
        "staf_torch/experiments/adp.py",
        "_NAMED = 20  # diverged trajectories that the log lists by number",
        "20",
        "21",
    ): "how much a log lists",
    (
        "staf_torch/sweeps/workers.py",
        "while time.monotonic() - since < patience:",
        "time.monotonic() - since < patience",
        "(time.monotonic() - since <= patience)",
    ): _TIE,
    (
        "staf_torch/systems/user_plants.py",
        "x, u = torch.zeros(dim, dtype=torch.float64), torch.zeros(inputs, dtype=torch.float64)",
        "torch.zeros(inputs, dtype=torch.float64)",
        "torch.zeros(inputs)",
    ): _ONES,
    ("staf_torch/metrics/ball_error.py", "self._seen += x.numel() // x.shape[-1]", "-1", "(1)"): _SPEED,
    (
        "staf_torch/online/tuning.py",
        "count = left_out.shape[1]",
        "1",
        "2",
    ): "of (S, n, n): as many choices as coordinates",
    (
        "staf_torch/theory/minimal_count.py",
        "grid = extent * ball_grid(dim, _SHELLS, _DIRECTIONS.get(dim, 256)).to(states)",
        "256",
        "257",
    ): _LIMIT,
    (
        "staf_torch/adp/global_value.py",
        "far = (self.problem.offset(now, last) / self.region).square().sum(-1) >= self.spacing**2",
        "-1",
        "(1)",
    ): _ROWS,
    (
        "staf_torch/online/local_functions.py",
        "pairs = None if rate is None else (gram.unsqueeze(1) * shared.mT).flatten(0, 1)",
        "rate is None",
        "(rate is not None)",
    ): _SPEED,
    (
        "staf_torch/sweeps/member_rows.py",
        "_DIGITS = 16  # of the hash of what made a row: enough to tell two settings apart",
        "16",
        "17",
    ): "how long a name is",
    (
        "staf_torch/adp/shooting/newton.py",
        "for _ in range(2 * slope.shape[-1]):",
        "2",
        "3",
    ): "passes of a search that has ended before",
    (
        "staf_torch/adp/adaptation/parametric.py",
        "theta=torch.ones(plant.inputs, dtype=torch.float64),",
        "torch.ones(plant.inputs, dtype=torch.float64)",
        "torch.ones(plant.inputs)",
    ): "the constructor makes float64 of it",
    ("staf_torch/lanes/combinators.py", "_FEW = 4  # passes of a loop that is only tried", "4", "5"): _SPEED,
    (
        "staf_torch/lanes/runs.py",
        "step, length = 0, 1",
        "0",
        "1",
    ): "a step to another source, which no run takes",
    (
        "staf_torch/lanes/eliminations.py",
        "for i in range(1, rest.shape[-1]):",
        "1",
        "2",
    ): "of a square, whose sides are equal",
    (
        "staf_torch/experiments/adp.py",
        "rows = range(min(_LINEARISED, len(result.state)) if result.actor_weights.shape[-1] else 1)",
        "1",
        "2",
    ): "without weights every row has the same loop: one is enough, two find the same",
    (
        "staf_torch/kernels/matern.py",
        "near = t2 < _SERIES_BELOW**2",
        "2",
        "3",
    ): "both ways are exact there, value and derivatives",
    (
        "staf_torch/adp/identification.py",
        "return torch.where(change > self.novelty**2 * s.square().sum(-1), empty, -1)",
        "1",
        "2",
    ): "a place that is none, as any below 0 is",
    (
        "staf_torch/online/experience_memory.py",
        "here = torch.where(fine.unsqueeze(-1), x, 0.0).to(self.states)",
        "0.0",
        "1.0",
    ): "of a row that is not stored",
    (
        "staf_torch/online/bank_definition.py",
        'doubtful = bool((seen & (away > most * torch.maximum(s["variance"], s["pace"]).sqrt())).any())',
        'away > most * torch.maximum(s["variance"], s["pace"]).sqrt()',
        "(away >= most * torch.maximum(s['variance'], s['pace']).sqrt())",
    ): _TIE,
    (
        "staf_torch/local_basis/graded.py",
        "terms: Tensor = (vector @ columns).unflatten(-1, self.inverse.shape[-3:-1])",
        "3",
        "4",
    ): "of (K, M, M), the one shape that comes there",
    (
        "staf_torch/lanes/eliminations.py",
        "best = torch.where(order < 0, whole[..., 0].abs(), -1.0).argmax(-1, keepdim=True)",
        "1.0",
        "2.0",
    ): "below every size, as any negative number is",
    (
        "staf_torch/adp/box_filter.py",
        "return torch.where(done.unsqueeze(-1) > 0, u, found), torch.maximum(done, met), 0 * left + _LEAST",
        "-1",
        "(1)",
    ): _ROWS,
    (
        "staf_torch/centers/layouts.py",
        "return torch.stack((angle.sin(), angle.cos()), dim=-1)",
        "-1",
        "(1)",
    ): "of angles (N,)",
    (
        "staf_torch/lanes/schedule.py",
        "if loop.node in self.live and loop.node not in self.ahead and graph.depth[loop.node] != ROW:",
        "loop.node in self.live and loop.node not in self.ahead and graph.depth[loop.node] != ROW",
        "(loop.node in self.live or loop.node not in self.ahead or graph.depth[loop.node] != ROW)",
    ): _SPEED,
    (
        "staf_torch/systems/integrators.py",
        '_kept = Kept("a trajectory", 16)',
        "16",
        "17",
    ): "how many programs are kept",
    (
        "staf_torch/lanes/tracer.py",
        "return self.pack(np.array(list(place), dtype=np.int64), kind), np.array(places, dtype=np.int64)",
        "np.array(places, dtype=np.int64)",
        "np.array(places)",
    ): "the dtype that NumPy gives whole numbers",
    (
        "staf_torch/local_basis/graded.py",
        "for j in range(top + terms - 1, top, -1):",
        "top + terms - 1",
        "(top + terms + 1)",
    ): "two more terms of a series that has converged",
    (
        "staf_torch/lanes/combinators.py",
        "loop.carry += [graph.args[new[0]][0]] if large else new",
        "0",
        "1",
    ): "the array that all of its entries are of",
    (
        "staf_torch/kernels/base.py",
        "if own is None or left is None:",
        "own is None or left is None",
        "(own is None and left is None)",
    ): "a kernel has a gradient for all arguments or for none",
    ("staf_torch/lanes/fusion.py", "_LONGEST = 24  # operations in one expression", "24", "25"): _SPEED,
    (
        "staf_torch/settings/trust.py",
        "return 0",
        "0",
        "1",
    ): "memory where the system tells none, which Linux does",
    (
        "staf_torch/cli/doctor.py",
        "found = float(chase(states, basis, Paper(), SteepestDescent(), inner_steps=10).excess[0, -1])",
        "chase(states, basis, Paper(), SteepestDescent(), inner_steps=10)",
        "chase(states, basis, Paper(), SteepestDescent())",
    ): "ten is the default",
    (
        "staf_torch/figures/safety.py",
        "reach = 0.06 * (ends[1] - ends[0])",
        "ends[1] - ends[0]",
        "(ends[1] + ends[0])",
    ): "how far the shade behind a wall reaches",
    (
        "staf_torch/adp/receding_horizon.py",
        "done, steps = plan[:, :1], plan[:, 1:].unflatten(-1, (self.steps, width))",
        "-1",
        "(1)",
    ): _ROWS,
    (
        "staf_torch/centers/layouts.py",
        "if float(cardinal[row, column].abs()) < 1.01:",
        "float(cardinal[row, column].abs()) < 1.01",
        "(float(cardinal[row, column].abs()) <= 1.01)",
    ): _TIE,
    (
        "staf_torch/lanes/tracer.py",
        "one = graph.constant(1.0, graph.type[int(array.flat[0])])",
        "0",
        "1",
    ): "the type of an array's entries, which all have the same",
    (
        "staf_torch/engine/api.py",
        "if self._program is not None:  # nothing but what it returns is kept",
        "self._program is not None",
        "(self._program is None)",
    ): "pieces of time, on which no result depends",
    (
        "staf_torch/adp/detour_plans.py",
        "found = self._rows(torch.cat((x, known), dim=-1))",
        "-1",
        "(1)",
    ): _ROWS,
    (
        "staf_torch/experiments/avoidance.py",
        "return torch.zeros(2, dtype=torch.float64)",
        "torch.zeros(2, dtype=torch.float64)",
        "torch.zeros(2)",
    ): _ONES,
    (
        "staf_torch/lanes/fusion.py",
        "if 8 * len(entries) > 10 * len(set(entries)) or length[node] + more > _LONGEST:",
        "8 * len(entries) > 10 * len(set(entries)) or length[node] + more > _LONGEST",
        "(8 * len(entries) > 10 * len(set(entries)) and length[node] + more > _LONGEST)",
    ): _SPEED,
    (
        "staf_torch/lanes/tracing.py",
        'shapes = ({0: Dim("batch", min=1)},) if batch is None else None',
        "1",
        "2",
    ): "the program takes one row all the same: torch checks no lower end",
    (
        "staf_torch/lanes/program.py",
        "program = Program(step, name=self.name, compile=self.compile, copies=self.copies)",
        "Program(step, name=self.name, compile=self.compile, copies=self.copies)",
        "Program(step, compile=self.compile, copies=self.copies)",
    ): "a name in messages",
    (
        "staf_torch/metrics/chase.py",
        "last = 0.0 if member.first <= 0 else _largest(found.last_above, rows, kept)",
        "member.first <= 0",
        "(member.first < 0)",
    ): "nothing is above the largest excess of a window that begins at 0",
    (
        "staf_torch/cli/deployable.py",
        "OmegaConf.set_struct(cfg, True)  # a setting that is missing is an error, not None",
        "True",
        "False",
    ): "every setting that a run has is looked at, so that None says the same sentence: all were tried",
    (
        "staf_torch/deploy/c_header.py",
        'uniform = row.get("uniform", x0.new_zeros(1, 0, x0.shape[-1]))',
        "0",
        "1",
    ): "a controller that draws nothing does not look at what is drawn",
    ("staf_torch/adp/safety_filter.py", "steps, least, most, acted = record.unbind(-1)", "-1", "(1)"): _ROWS,
    ("staf_torch/figures/sweep.py", "axes.grid(False)", "axes.grid(False)", "pass"): _LOOKS,
    (
        "staf_torch/online/mixture_definition.py",
        's["blend"].copy_(torch.cat((straight, mapped[:, None]), -1))',
        "-1",
        "(1)",
    ): "of (K, B), the one shape that comes there",
    (
        "staf_torch/adp/following.py",
        "(last, paid), _ = scan(step, (x, torch.zeros_like(x[:, 0])), window)",
        "0",
        "1",
    ): "zeros like another column, which has the same shape",
    (
        "staf_torch/sweeps/workers.py",
        "os._exit(1)",
        "1",
        "2",
    ): "a code that nobody reads: who would read it has ended",
    (
        "staf_torch/sweeps/launcher.py",
        "self._directory.mkdir(parents=True, exist_ok=True)",
        "self._directory.mkdir(parents=True, exist_ok=True)",
        "pass",
    ): "Hydra's own sweeper makes it before; others need not",
    (
        "staf_torch/local_basis/graded.py",
        "if upper.dim() > 0 and upper.shape[-1] != 1:",
        "-1",
        "(1)",
    ): "of (B, 1), the one shape of bounds that differ by row",
    (
        "staf_torch/experiments/faults.py",
        'out.table("faults", dataclasses.replace(Table.of(table, _COLUMNS), style=Style(digits=5)))',
        "5",
        "6",
    ): _DIGITS,
    (
        "staf_torch/experiments/laws.py",
        "errors = StateErrorPass(problem.basis, problem.target, expected=expected)  # of the same states "
        "always",
        "StateErrorPass(problem.basis, problem.target, expected=expected)",
        "StateErrorPass(problem.basis, problem.target)",
    ): _SPEED,
    (
        "staf_torch/figures/chase.py",
        'axes.set_aspect("equal", adjustable="datalim")',
        'axes.set_aspect("equal", adjustable="datalim")',
        "axes.set_aspect('equal')",
    ): "which of the box and the limits gives way to equal units",
    (
        "staf_torch/adp/adaptation/adaptive_lqr.py",
        "self._like = self._start(torch.zeros(1, int(model.dim or 0), dtype=torch.float64), None)",
        "0",
        "1",
    ): "a model of no states, which its constructor refuses",
    (
        "staf_torch/experiments/adp.py",
        "return int(8 * 40 * min(rows * duration / dt, 2e5))  # type: ignore[operator]",
        "40",
        "41",
    ): "about how many bytes",
    (
        "staf_torch/experiments/faults.py",
        "law = LeastSquares([0.0] * 4 + [1.0] * 2, deviation=[10.0] * 4 + [1.0] * 2, floor=1e-5)",
        "0.0",
        "1.0",
    ): "a first estimate, and every row has its own",
    (
        "staf_torch/engine/row_program.py",
        "gram = _symmetric(structure.scaled()).expand(*x.shape[:-1], problem.basis.count, "
        "problem.basis.count)",
        "-1",
        "(1)",
    ): _ROWS,
    (
        "staf_torch/adp/detour_plans.py",
        "improved = self._begun(torch.cat((x, found), dim=-1))",
        "-1",
        "(1)",
    ): _ROWS,
    ("staf_torch/numerics/box.py", "lower = cost < value", "cost < value", "(cost <= value)"): _TIE,
    (
        "staf_torch/theory/uniform_approximation.py",
        "better = gained > best",
        "gained > best",
        "(gained >= best)",
    ): _TIE,
    (
        "staf_torch/experiments/avoidance.py",
        "return int(torch.where(collides, nearest, nearest + 100).argmin())",
        "100",
        "101",
    ): "metres, farther than any disc is",
    (
        "staf_torch/metrics/ball_error.py",
        "if any(part.dim() > 2 and part.shape[-3] > 1 for part in (offsets, core)):",
        "part.shape[-3] > 1",
        "(part.shape[-3] >= 1)",
    ): _SPEED,
    (
        "staf_torch/centers/layouts.py",
        "update[column] -= 1.0",
        "update[column] -= 1.0",
        "update[column] += 1.0",
    ): "the sign of a column, of which the size alone counts",
    (
        "staf_torch/lanes/captured.py",
        "at += (np.arange(size) * stride).reshape([-1] + [1] * (tensor.dim() - axis - 1))",
        "1",
        "2",
    ): "any negative length is the unknown one to NumPy",
    (
        "staf_torch/engine/api.py",
        "carry._replace(time=torch.full_like(old, begins), diverged_at=old.clamp(max=0)),",
        "0",
        "1",
    ): "a time at which rows diverged before, of which only the sign counts",
    (
        "staf_torch/systems/mujoco_plant.py",
        "lost = np.logical_or.accumulate(~(found[1:, :, 0] > found[:-1, :, 0]), axis=0)",
        "np.logical_or.accumulate(~(found[1:, :, 0] > found[:-1, :, 0]), axis=0)",
        "np.logical_or.accumulate(~(found[1:, :, 0] > found[:-1, :, 0]))",
    ): "0 is the axis of NumPy's choice",
    (
        "staf_torch/systems/equilibria.py",
        "if not bool(torch.isfinite(u).all()) or float(step.norm()) <= 1e-14 * (1 + float(u.norm())):",
        "1",
        "2",
    ): "a tolerance of twice 1e-14: one step of Newton less, below the rounding of the motion",
    (
        "staf_torch/systems/integrators.py",
        "_PAYS = 10_000  # steps of a small batch in plain torch (some .1 ms each) that take as long as to "
        "compile",
        "10_000",
        "10001",
    ): _SPEED,
    ("staf_torch/systems/barrier.py", "left = s < 0", "s < 0", "(s <= 0)"): (
        "both branches are the same function at 0, value and slope"
    ),
    (
        "staf_torch/adp/shooting/newton.py",
        "_SHORTER = (0.5, 0.25, 0.1, 0.03, 0.01)  # shares of the Newton step, where the whole one does not "
        "pay",
        "0.03",
        "0.06",
    ): "another share of a step that is tried: the search ends at the same optimum",
    (
        "staf_torch/systems/barrier.py",
        "scale.unsqueeze(-1) * found.matrix / scale, scale.unsqueeze(-1) * found.input_matrix",
        "-1",
        "(1)",
    ): "of one state: the scale has one dimension",
    (
        "staf_torch/adp/rollout.py",
        "if first is not None and second is not None and first.direct and second.direct:",
        "first is not None",
        "(first is None)",
    ): _SPEED,
    (
        "staf_torch/results/archive.py",
        "_DIRECTORY = 2**16  # bytes of the list of arrays at most",
        "16",
        "17",
    ): "a limit against hostile files: no file of ours comes near",
    (
        "staf_torch/online/local_functions.py",
        "zero = offsets.new_zeros(offsets.shape[-1])",
        "1",
        "2",
    ): "a state that is not read: the kernel does not depend on it",
    (
        "staf_torch/adp/laws.py",
        "first, rest = here * masses.new_ones(1), there * masses",
        "here * masses.new_ones(1)",
        "(here / masses.new_ones(1))",
    ): "over ones as times ones",
    (
        "staf_torch/theory/ultimate_bound.py",
        "count = math.ceil(math.log(q) / math.log(one) - 1e-12)",
        "1e-12",
        "2e-12",
    ): "room for the rounding of a quotient of logarithms, some 1e-16 of it",
    (
        "staf_torch/lanes/emission.py",
        "mask, count = masks.most_common(1)[0] if masks else (-1, 0)",
        "1",
        "2",
    ): "the first of the two most common is the most common; -2 names no node, as -1 does not",
    ("staf_torch/adp/memory_growth.py", "22,", "22", "23"): (
        "another time that a guess holds a corner of the bounds: the best of many guesses is kept"
    ),
    (
        "staf_torch/lanes/plan.py",
        "ends = [((rows, *s), (1, *_inner(s, rows)), s.numel(), 0) for s, _ in compiled.carry]",
        "0",
        "1",
    ): "stride from time to time of what has one time: never read",
    (
        "staf_torch/adp/safety_filter.py",
        "time = torch.as_tensor(0.0 if t is None else t).to(x).expand(x.shape[:-1])",
        "0.0",
        "1.0",
    ): "a time on which no constraint depends: else it must be given",
    (
        "staf_torch/adp/memory_growth.py",
        "search = BoxDDP(problem, steps=steps, iterations=40, tolerance=1e-5)",
        "40",
        "41",
    ): "the limit of a search that mostly ends before",
    (
        "staf_torch/lanes/captured.py",
        "nodes = np.array([places[start + place] for place in flat], dtype=np.int64)",
        "np.array([places[start + place] for place in flat], dtype=np.int64)",
        "np.array([places[start + place] for place in flat])",
    ): "whole numbers become int64 by themselves, but for NumPy 1 on Windows",
    (
        "staf_torch/online/tuning.py",
        "ROUNDS = (0.6, 0.3)  # spread of the logarithms of the candidates around the best so far",
        "0.3",
        "0.6",
    ): "another spread of the candidates of a random search: the best of all is kept",
    (
        "staf_torch/online/experience_memory.py",
        "still = (x - self.origin).square().sum(-1) < limit.square()",
        "(x - self.origin).square().sum(-1) < limit.square()",
        "((x - self.origin).square().sum(-1) <= limit.square())",
    ): "a state to the last bit at the edge between two ways to remember it",
    (
        "staf_torch/lanes/combinators.py",
        "if count > 1 and (tracer := _tracer(carry)) is not None:",
        "1",
        "2",
    ): "whether a loop of two passes is written out or not",
    (
        "staf_torch/sweeps/launcher.py",
        "self._bar = tqdm(total=total, bar_format=layout, leave=False, disable=None, file=sys.stderr)",
        "tqdm(total=total, bar_format=layout, leave=False, disable=None, file=sys.stderr)",
        "tqdm(total=total, bar_format=layout, disable=None, file=sys.stderr)",
    ): "whether the bar of progress stays on a terminal behind the last job",
    ("staf_torch/results/progress.py", "_LINE_EVERY = 10.0  # s", "10.0", "20.0"): (
        "seconds between two lines of a log"
    ),
    (
        "staf_torch/approximation/coefficient_format.py",
        "return torch.tensor(list(json.dumps(record, sort_keys=True).encode()), dtype=torch.uint8)",
        "json.dumps(record, sort_keys=True)",
        "json.dumps(record)",
    ): "the order of names in a record that is read by name",
    (
        "staf_torch/lanes/rolled_eliminations.py",
        "place, zero = _places(gram), torch.zeros_like(gram[..., 0])",
        "0",
        "1",
    ): "zeros like another column, which has the same shape",
    (
        "staf_torch/deploy/approximators.py",
        "sums = torch.addmm(self.constant, torch.cat(powers, dim=-1), self.table)",
        "-1",
        "(1)",
    ): "of (B, n), the one shape that an exported approximator takes",
    (
        "staf_torch/experiments/adp_tracking.py",
        "shown = [significant(value, 4) for value in measured.values()]",
        "4",
        "5",
    ): "digits of a line of the log",
    (
        "staf_torch/kernels/matern.py",
        "small = torch.where(near, t2, 0.0)",
        "0.0",
        "1.0",
    ): "of the branch that is not taken: any number that has a square root does",
    (
        "staf_torch/adp/adaptation/redesign.py",
        "identity = torch.eye(now.a.shape[-1], dtype=now.a.dtype, device=now.a.device)",
        "1",
        "2",
    ): "of a square matrix: both dimensions are one",
    (
        "staf_torch/adp/shooting/newton.py",
        "_LEAST_CURVATURE = 1e-6  # of its largest eigenvalue, that a convexified interval keeps",
        "1e-6",
        "2e-06",
    ): "a tolerance of a search, another of the same order",
    (
        "staf_torch/figures/sweep.py",
        'far = ", below" if rounding <= _far_below(panels) else ""',
        "rounding <= _far_below(panels)",
        "(rounding < _far_below(panels))",
    ): "two numbers of a figure that are equal to the last bit",
    (
        "staf_torch/adp/safety_filter.py",
        "_PROBES, _TIMES = 32, (0.0, 0.1, 1.0, 10.0, 100.0)  # states and times (s) at which "
        "constraints are tried",
        "0.0",
        "1.0",
    ): "one of the times at which constraints are tried",
    (
        "staf_torch/figures/animation.py",
        "margin = 0.08 * (high - low) or 1.0",
        "1.0",
        "2.0",
    ): "the margin of an axis along which nothing changes",
    (
        "staf_torch/figures/chase.py",
        'ball.set(markerfacecolor="none", markersize=8)',
        "8",
        "9",
    ): "how a mark of a figure is drawn, not where",
    (
        "staf_torch/lanes/emission.py",
        "self._level -= 1",
        "self._level -= 1",
        "self._level += 1",
    ): "blanks before a line of generated text",
    (
        "staf_torch/experiments/rival_methods.py",
        'deep = {"rounds": 6, "candidates": 64, "lookahead": 120} if case.dim > 2 else {}',
        "6",
        "7",
    ): "rounds of a search, of which the best is kept",
    (
        "staf_torch/adp/plan_problem.py",
        "value: Tensor = found[0][0]",
        "0",
        "1",
    ): "the value is the same along every direction",
    (
        "staf_torch/adp/adaptation/history_stack.py",
        "identity = torch.eye(theta.shape[-1], dtype=theta.dtype, device=theta.device)",
        "torch.eye(theta.shape[-1], dtype=theta.dtype, device=theta.device)",
        "torch.eye(theta.shape[-1], device=theta.device)",
    ): "ones and zeros are the same numbers in single precision",
    (
        "staf_torch/sweeps/workers.py",
        "threading.Thread(target=watch, daemon=True).start()",
        "threading.Thread(target=watch, daemon=True)",
        "threading.Thread(target=watch)",
    ): "of systems other than Linux, which machines that run the tests are not",
    (
        "staf_torch/online/smoothing.py",
        "variance = (rest + (psi.mT @ p @ psi).squeeze(-1).squeeze(-1)) * factor.square()",
        "-1",
        "(1)",
    ): "of one column: both dimensions have size 1",
    (
        "staf_torch/experiments/faults.py",
        "best = torch.full((rows,), torch.nan, dtype=torch.float64)",
        "torch.full((rows,), torch.nan, dtype=torch.float64)",
        "torch.full((rows,), torch.nan)",
    ): "NaN until every entry is written",
    (
        "staf_torch/lanes/rolled_choices.py",
        'others = 1 if name != "index_select" else a.numel() // max(1, a.shape[dim])',
        'name != "index_select"',
        "(not (name != 'index_select'))",
    ): "decides which of two ways that find the same is taken: the threshold is of speed alone",
    (
        "staf_torch/theory/uniform_approximation.py",
        "share = torch.full_like(f, 1 / f.shape[-1])  # of each point in the squared error, sums to one",
        "-1",
        "(1)",
    ): "of two dimensions the second is the last",
    (
        "staf_torch/adp/near_optimal.py",
        "began = self.cost.deviation(x0).norm(dim=-1)",
        "-1",
        "(1)",
    ): "of two dimensions the second is the last",
    (
        "staf_torch/systems/black_box.py",
        "if u.shape[:-1] != lead:",
        "-1",
        "(1)",
    ): "shapes that agree are broadcast to themselves",
    (
        "staf_torch/theory/uniform_approximation.py",
        "share = share / share.sum(-1, keepdim=True).clamp(min=torch.finfo(f.dtype).tiny)",
        "-1",
        "(1)",
    ): "of two dimensions the second is the last",
}
