"""Row programs: a step of one row over many times and rows, in plain torch or compiled."""

from __future__ import annotations

import operator
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from ..signs import Sign
from .adjoint.steps import keeping_step
from .calls.choice import say
from .calls.inputs import Given, one_precision, seen, served, whole
from .calls.planned_call import Compiled
from .compilation.compiler import machine_code
from .dependencies.contents import Contents
from .dependencies.walk import Derived
from .emit.cpp import emit
from .emit.row_c import RowC
from .prepared_call import Prepared
from .row_numbers import over_rows, points_of_rows
from .texts import Built, Form, kernel, known
from .threads import ENTRIES, Mutex, alone
from .torch_compile.operators import one_operator
from .trace.loops import few_passes, scan, tracing_now
from .trace.row_independence import doubt, undrawn
from .trace.step import Step, trace
from .trace.step_copy import NoReverseError
from .trace.tracer import NotLoweredError
from .tree import Shared, Tree, flatten, mapped, plain, unflatten

Some = TypeVar("Some", bound=Tensor)
_FEW = 8  # rows that one vector holds
_LONGEST = 20_000  # lines that a compiler is asked to take: half a minute
_PREPARED = 64  # calls of other shapes that a program remembers


class Program(Derived):
    """A step of a row, taken at all times: carry, out_k = step(carry, now_k, row).

    Example:
        >>> def step(x, u, row):
        ...     gain, = row
        ...     x = x + 0.01 * (u - gain * x.sin())
        ...     return x, x
        >>> program = lanes.Program(step)
        >>> x0, u, gain = torch.zeros(5), torch.ones(5, 100), torch.rand(5)
        >>> x, history = program(x0, u, (gain,))
        >>> history.shape
        torch.Size([5, 100])

        Shown by `staf_torch/lanes/README.md`.

    The definition is plain torch: ``step`` with all rows, time after time. The compiled program runs ``step``
    once with a single row, (1, ...), writes down what it does as a scalar program and computes that with a
    row in every vector lane. Where that cannot be done, one line of the log says why and the definition runs;
    so it does where a transform of torch looks at it. What has ``requires_grad``, inputs and tensors that
    ``step`` reads, gets its gradient from a second such program (`GRADIENTS.md`).

    What a function ``step`` finds elsewhere (globals, closures, tensors and attributes there) may change
    between calls: the program is then made anew. A constant is what cannot be watched (an object without a
    ``__dict__``, an array of NumPy beyond 16 kB), of which a line of the log tells, and all of it for a call
    that was prepared. Rows never see each other.

    Args:
        step: maps (carry, now, row), trees of tensors (B, ...), to the next carry and the outputs (B, ...).
        name: in the log.
        compile: whether to compile at all.
        copies: vectors of rows that advance side by side; 0 by the number of rows and the program.
    """

    def __init__(self, step: Step, *, name: str = "program", compile: bool = True, copies: int = 0) -> None:
        self.step, self.name, self.compile, self.copies = step, name, compile, copies
        self._lock = Mutex()  # of what is built: one thread builds, the others wait for it
        self._compiled: dict[Hashable, Built | None] = {}
        self._prepared: dict[Hashable, Prepared] = {}
        self._model: tuple[Program, Mapping[int, Tensor]] | None = None
        self._builds = False  # whether that is built first, if it was not
        self._followers: dict[Hashable, Program] = {}  # of steps that are made from this one
        self.adjoints: dict[Hashable, Any] = {}  # what is known of them, by the trace and what has a gradient
        self._tensors: Sequence[Tensor] = ()  # that the step reads, as far as is known
        self._described: tuple[bytes, Sequence[Tensor]] | None = None
        self._read: Contents | None = None  # what the step reads, once it is compiled
        self._watched = True  # whether a change there is looked for
        self._of_users: bool | None = None  # whether the step is of a user, or reads what a user wrote
        self._asked = 0  # rows with which `doubt` was asked
        self._refused: str | None = None  # why its rows are not alone

    def __getstate__(self) -> dict[str, Any]:
        """Return the parts that a copy is made of: it compiles by itself."""
        return {"step": self.step, "name": self.name, "compile": self.compile, "copies": self.copies}

    def __setstate__(self, state: dict[str, Any]) -> None:
        Program.__init__(self, **state)

    @property
    def compiled(self) -> bool:
        """Return whether compiled code serves all kinds of input that came so far, one at least."""
        return bool(self._compiled) and all(built is not None for built in self._compiled.values())

    def described(self, by: bytes | None, tensors: Sequence[Tensor]) -> None:
        """Let traces go through the user's cache; whoever describes a step looks for changes himself.

        ``by`` tells steps apart, in any process, that differ in more than ``tensors``, all floating-point
        ones that the step reads; None where nothing does.
        """
        self._described, self._tensors = None if by is None else (by, tensors), tensors
        self._of_users, self._watched = (None if by is None else False), False

    def with_others(self, step: Step, others: Sequence[tuple[Tensor, Tensor]]) -> Program:
        """Return the program of a step that differs in captured tensors alone: nothing is traced again.

        What torch made of the captured tensors is made again from the others; the text is the same. Where
        the step came upon a floating-point tensor that is not named here, or read a number that is now
        another, the new step is traced after all.

        Args:
            step: as the step of this program, with the other tensors.
            others: pairs of a tensor that this step captured and what the new one has in its place.
        """
        program = Program(step, name=self.name, compile=self.compile, copies=self.copies)
        program._model = self, {id(old): new for old, new in others}
        program._of_users, program._asked, program._refused = self._of_users, self._asked, self._refused
        program.adjoints = self.adjoints
        return program

    @one_operator
    def __call__(
        self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None, every: int = 1
    ) -> tuple[Tree, Tree]:
        """The carry after the last step, and the outputs at the times 0, ``every``, 2 ``every``, ...

        Args:
            carry: a tree of tensors (B, ...).
            now: a tree of tensors (B, T, ...), or `Shared` (T, ...).
            row: a tree of tensors (B, ...), or `Shared` (...).
            steps: T where ``now`` is empty.
            every: times from one recorded output to the next.

        Returns:
            The carry, (B, ...), and the outputs, (B, ceil(T / every), ...).
        """
        times = flatten(now)[0] if tracing_now() and every == 1 else ()
        if times and not any(isinstance(leaf, Shared) for leaf in times):  # within a program that is traced
            return scan(lambda carry, now: self.step(carry, now, row), carry, now)
        if not self.compile:  # nothing to prepare or to watch
            return self.definition(carry, now, row, steps=steps, every=whole("every", every, 1))
        self._look_around()
        leaves, structure = flatten((row, now, carry))
        known = self._prepared  # of this step: another dictionary takes its place where that changes
        try:
            forms, where = seen(leaves)
            prepared = known.get(key := (structure, forms, steps, every))
        except (RuntimeError, TypeError):  # something that is no tensor here, or not dense: this names it
            Given.of(carry, now, row, steps)
            raise
        if prepared is None:
            if len(known) >= _PREPARED:
                known.clear()
            prepared = known[key] = self.prepare(carry, now, row, steps=steps, every=every)
        return prepared.run(leaves, where, carry, now, row)

    def over(self, points: tuple[Tensor, ...], fixed: tuple[Tensor, ...] = ()) -> Tree:
        """The outputs of one step without a carry at many points of every row: (B, P, ...).

        Each point is a row of the program, but a pass of a loop within a program that is traced.

        Args:
            points: inputs (B, P, ...) of the step.
            fixed: inputs (B, ...) before them, the same at all points of a row.
        """
        if tracing_now():
            return scan(lambda _, now: ((), self.step((), (), (*fixed, *now))[1]), (), points)[1]
        shape = points[0].shape[:2]
        spread = [part.unsqueeze(1).expand(*shape, *part.shape[1:]) for part in fixed]
        rows = tuple(part.flatten(0, 1) for part in (*spread, *points))
        with points_of_rows(*shape):
            return mapped(lambda leaf: leaf.unflatten(0, shape), self.once(*rows))

    def once(self, *row: Tree) -> Tree:
        """The outputs of one step without a carry, (B, ...)."""
        return mapped(lambda leaf: leaf[:, 0], self((), (), row, steps=1)[1])

    def prepare(
        self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None, every: int = 1
    ) -> Prepared:
        """Return the call for inputs of the forms of these, with everything found out that does not change.

        For one state and few steps: a call then costs some 20 microseconds and the arithmetic.

        Args:
            carry, now, row, steps, every: as in a call; only shapes, strides and dtypes matter.
        """
        return Prepared(self, Given.of(carry, now, row, steps), every)

    def definition(
        self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None, every: int = 1
    ) -> tuple[Tree, Tree]:
        """Compute in plain torch."""

        def all_times(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
            return self._all_times(Given.of(carry, now, row, steps), carry, every)

        with one_precision(self.name, carry, now, row):
            return over_rows(all_times, carry, now, row)

    def _all_times(self, given: Given, carry: Tree, every: int) -> tuple[Tree, Tree]:
        fixed = given.tree("row", [plain(leaf) for leaf in given.row])
        columns, shape = list[list[Tensor]](), cast("Any", ("fixed", ()))
        with alone(given.rows * ENTRIES), few_passes(formal := given.formal):
            for k in range(1 if formal else given.times):
                at = [leaf.tensor[k] if isinstance(leaf, Shared) else leaf[:, k] for leaf in given.now]
                carry, out = self.step(carry, given.tree("now", at), fixed)
                if k % every == 0:
                    parts, shape = flatten(out)
                    columns.append(parts)
        stacked = [torch.stack(column, dim=1) for column in zip(*columns, strict=True)]
        if formal:
            count = -(-given.times // every)
            stacked = [one.expand(-1, count, *one.shape[2:]).contiguous() for one in stacked]
        return carry, unflatten(shape, iter(stacked))

    def compiles(self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None) -> bool:
        """Return whether the compiled program serves these inputs."""
        self._look_around()
        leaves, structure = flatten((row, now, carry))
        forms, where = seen(leaves)
        prepared = self._prepared.get((structure, forms, steps, 1))
        if prepared is not None and prepared.plan is not None and where and not self.differentiated():
            return True  # it has served such ones
        if not served(leaves):
            return False
        self.reads()
        wanted, given = self.differentiated() or not where, Given.of(carry, now, row, steps)
        with torch.no_grad():
            return (self.keeping(given) if wanted else self.find(given)) is not None

    def text(self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None) -> str:
        """The C++ of the program for such inputs.

        Raises:
            NotLoweredError: if there is none.
        """
        traced = trace(self.step, Given.of(carry, now, row, steps))
        return emit(*traced.program, self.copies).source

    def cuda_source(self, carry: Tree, now: Tree = (), row: Tree = (), *, steps: int | None = None) -> str:
        """The CUDA C of the program for such inputs, a thread a row, as it runs on a device.

        Its numbers are those of a table that comes with a call.

        Args:
            carry, now, row, steps: as in a call; only shapes and dtypes matter.

        Raises:
            NotLoweredError: if there is none.
        """
        given = Given.of(carry, now, row, steps)
        return kernel(trace(self.step, given), given).source

    def c_source(
        self,
        name: str,
        carry: Tree = (),
        now: Tree = (),
        row: Tree = (),
        *,
        outputs: Sequence[str] | None = None,
        note: str = "",
    ) -> str:
        """Return a C99 header that takes one step of one row: nothing but math.h and the stack.

        ``NAME_start(state)`` sets the carry to the numbers of row 0 of ``carry``;
        ``NAME(state, now..., row..., out...)`` advances it and writes the outputs. Without a carry there is
        no ``state``. Arguments are called as the keys of a dictionary or the fields of a named tuple, else
        ``carry0``, ``now``, ``out1``, ... What the step captured is the table ``NAME_numbers``, constant as
        long as ``NAME_NUMBERS`` is not defined to be something else.

        Args:
            name: of the function.
            carry, now, row: as in a call, with one time at least.
            outputs: names of the outputs.
            note: lines for the comment at the head.

        Raises:
            NotLoweredError: if an operation has no scalar form, or the step is more than a function of a row.
            ValueError: if a name is not one of C, or is there twice.
        """
        return self.row_c(carry, now, row).text(name, outputs, note)

    def row_c(self, carry: Tree, now: Tree, row: Tree, *known: Any) -> RowC:
        """Return the step of one row traced for C; ``known`` as in `RowC.of`."""
        given = Given.of(carry, now, row, 1)
        if not self._alone(given):
            raise NotLoweredError(f"its step {self._refused}")
        return RowC.of(self.step, given, *known)

    def find(self, given: Given) -> Compiled | None:
        """The compiled program for such inputs, None where there is none."""
        built = self.built(given)
        return None if built is None or not self._alone(given) else built.compiled

    def built(self, given: Given) -> Built | None:
        """Return the code built for such inputs, None where there is none."""
        where, place = given.ordinary(), self.place(given)
        known = self.latest(place) if self.compile and where else None
        if known is not None or not self.compile or not where:
            return known
        # What the step makes is where its inputs are, not on a default device.
        with self._lock, torch.device("cpu" if where is True else where):
            if place not in self._compiled:
                built = self._compiled[place] = self._again(place, given) or self._build(given, place[1])
                if built is not None:
                    read = (*self._tensors, *built.trace.recipe.found, *built.trace.rows)
                    self._tensors = [*{id(t): t for t in map(self.in_place_of, read)}.values()]
            return self._compiled[place]

    def place(self, given: Given) -> tuple[Hashable, Any]:
        """Return where what is built for such inputs stands: by their forms and that of the code."""
        where = given.ordinary()
        return given.key(), (self.copies or int(given.rows <= _FEW)) if where is True else where

    def latest(self, place: Hashable) -> Built | None:
        """Return what was built at a place, None where there is nothing now."""
        return self._compiled.get(place)

    def in_place_of(self, tensor: Some) -> Some:
        """Return the tensor that stands where the program that this one follows had another, or itself."""
        return tensor if self._model is None else cast("Some", self._model[1].get(id(tensor), tensor))

    def keeping(self, given: Given) -> tuple[Program, Built] | None:
        """Return the program that also puts out the carry before every step, and what was built of it."""
        if not given.ordinary() or not self._alone(given):
            return None
        self.reads()
        program = self.follower("keeping", lambda of: keeping_step(of.step), follows=True)
        built = program.built(given)
        return None if built is None else (program, built)

    def follower(self, kind: Hashable, step_of: Callable[[Program], Step], *, follows: bool) -> Program:
        """Return the program of a step that is made from this one's.

        It may be traced where the program was that this one ``follows``.
        """
        with self._lock:
            if kind not in self._followers:
                new = Program(step_of(self), name=self.name, copies=self.copies)
                new._of_users, new._watched = False, False
                if self._model is not None and follows:
                    model, others = self._model
                    new._model, new._builds = (model.follower(kind, step_of, follows=True), others), True
                if self._described is not None:
                    by, tensors = self._described
                    new.described(by + repr(kind).encode(), tensors)
                self._followers[kind] = new
            return self._followers[kind]

    def reads(self) -> Sequence[Tensor]:
        """Return the tensors that the step reads, as far as is known: all of them once it is compiled."""
        if self._read is None and self._watched:
            self._read = Contents(self.step)
            self._tensors = self._read.tensors
        return self._tensors

    def _alone(self, given: Given) -> bool:
        """Return whether a user's step may be traced with a single row, by calls with one row and more."""
        rows = min(given.rows, 2)
        if self._asked < rows and self._of_users is not False:
            again, self._asked = not self._asked, rows
            self._of_users = Contents(self.step).of_users
            if self._of_users:
                with one_precision(self.name, *given.trees()):
                    self._refused = self._refused or doubt(self.step, given, again=again)
            if self._refused is not None:
                say(self.name, f"its step {self._refused}")
        return self._refused is None

    def has_rows(self) -> bool:
        """Return whether numbers of a row's own are among what compiled code reads."""
        return any(built is not None and built.compiled.rows for built in self._compiled.values())

    def differentiated(self) -> bool:
        """Return whether a gradient by a tensor that the step found elsewhere is wanted."""
        return torch.is_grad_enabled() and any(map(_REQUIRES, self._tensors))

    def _look_around(self) -> None:
        """Forget what was compiled of a step that now reads something else."""
        read = self._read
        if read is None or read.unchanged(library=False):
            return
        with self._lock:
            if self._read is not read:  # another thread has looked meanwhile
                return
            self._prepared = {}
            if read.renewed() and self._renew():
                return
            self._compiled, self._followers, self._tensors, self.adjoints = {}, {}, (), {}
            self._read = self._model = self._refused = None
            self._asked = 0

    def _renew(self) -> bool:
        """Read the numbers of all tables again; return whether nothing else has changed."""
        for key, built in self._compiled.items():
            if built is not None:
                found = built.trace.recipe.found
                again = built.with_others({id(t): self.in_place_of(t) for t in found}, self.in_place_of)
                if again is None:
                    return False
                self._compiled[key] = again
        return all(follower._renew() for follower in self._followers.values())

    def _again(self, key: Hashable, given: Given) -> Built | None:
        """The program of the model with a table of other numbers, None where that cannot be."""
        if self._model is None:
            return None
        model, others = self._model
        built = model.built(given) if self._builds else model._compiled.get(key)
        again = None if built is None else built.with_others(others, self.in_place_of)
        return None if again is None else again._replace(followed=True)

    def _build(self, given: Given, form: Form) -> Built | None:
        self.reads()
        try:
            with undrawn(), Sign(f"compiling {self.name}"):
                made = known(self.step, self._described, given, form)
            if (lines := made.text.source.count("\n")) > _LONGEST:
                raise NotLoweredError(f"the program is {lines} lines long, which take a compiler minutes")
            if not self._alone(given):  # before a compiler is asked for what would not be used
                return None
            source = made.text.source
            call: Any = machine_code(source) if isinstance(form, int) else source
        except NoReverseError:  # there is another form
            return None
        except (NotLoweredError, OSError) as error:
            say(self.name, str(error), "no build" if isinstance(error, OSError) else None)
            return None
        if self._read is not None:
            self._read.warn(self.name)
        return Built.of(made, call, given)


_REQUIRES = operator.attrgetter("requires_grad")
