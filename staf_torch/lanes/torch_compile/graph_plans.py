"""Reading of a call for a graph: what runs while `torch.compile` follows `graph_operator.in_graph`.

All that is used here of torch's compiler is private to it. Where a version has it otherwise, the graph breaks
at the call, as it does wherever the operator would not be the call: an argument that was made within the
graph, an object that cannot be watched, a change of an object that the graph makes at its end.
"""

from __future__ import annotations

from types import FunctionType
from typing import Any

import torch
from torch import nn
from torch._dynamo import variables
from torch._dynamo.guards import GuardBuilder, install_guard
from torch._dynamo.symbolic_convert import InstructionTranslator
from torch._dynamo.variables.base import AttributeMutationNew, ValueMutationNew
from torch._subclasses import FakeTensor

from ..calls.inputs import transformed
from ..compiled_methods import CompiledMethod, bound_to
from ..dependencies.contents import Contents
from ..prepared_call import Prepared
from ..program import Program
from .operators import CALLS, KNOWN, NAMED, GraphCall, Surroundings, TensorForm

_CONSTANTS = (str, int, float, type(None), torch.dtype, torch.device)
_NEW = AttributeMutationNew, ValueMutationNew
_TENSORS = torch.Tensor, nn.Parameter, FakeTensor


def planned(name: str, structure: Any) -> str:
    """Return the name of a call.

    Raises:
        NotImplementedError: if the graph must break.
    """
    output = InstructionTranslator.current_tx().output
    effects = output.side_effects
    frame: dict[str, Any] = output.current_tx.symbolic_locals
    changed = [variable for variable in effects.id_to_variable.values() if _changes(effects, variable)]
    if changed:
        raise NotImplementedError(f"{_named(changed[0])} has been changed before it, in the same graph")
    if transformed() or output.export:
        raise NotImplementedError("a transform of `torch.func`, or an export, is active")
    parts = [part.realize() for part in frame["objects"].realize().items]
    values = [*map(_value, parts)]
    sources = [part.source for part, value in zip(parts, values, strict=True) if not _constant(value)]
    if not sources or None in sources:
        raise NotImplementedError("an argument has been made within the graph")
    for source in sources:
        install_guard(source.make_guard(GuardBuilder.ID_MATCH))
    examples = [_example(part) for part in frame["tensors"].realize().items]
    call = _known(name, structure, values, examples)
    known = [effects.id_to_variable.get(id(tensor)) for tensor in getattr(KNOWN, call.name)[0]]
    if any(_example(variable)._version for variable in known if variable is not None):
        raise NotImplementedError("a tensor that it reads has been changed before it, in the same graph")
    install_guard(sources[0].make_guard(_guard(call.name)))
    return call.name


def _changes(effects: Any, variable: Any) -> bool:
    """Return whether an object that was there before is to be changed at the end of the graph."""
    if variable in getattr(effects, "ignore_mutation_on_these_variables", ()):  # as `functional_call` has it
        return True
    return effects.is_modified(variable) and not isinstance(variable.mutation_type, _NEW)


def _named(variable: Any) -> str:
    """Return the name of a variable of torch's compiler."""
    name = getattr(variable.source, "name", "an object")
    return str(name() if callable(name) else name)  # a method in torch 2.6


def _example(variable: Any) -> torch.Tensor:
    found: torch.Tensor = variable.as_proxy().node.meta["example_value"]
    return found


def _value(part: Any) -> Any:
    """Return the object that a variable of torch's compiler stands for."""
    if isinstance(part, variables.UserDefinedObjectVariable):
        return part.value
    if isinstance(part, variables.SymNodeVariable):
        return part.evaluate_expr()
    value = part.as_python_constant()
    return vars(value).get("spells", value) if isinstance(value, FunctionType) else value


def _constant(value: Any) -> bool:
    return isinstance(value, _CONSTANTS)


def _known(name: str, structure: Any, values: list[Any], examples: list[Any]) -> GraphCall:
    """Return the call with these arguments, the one of an earlier graph where there is one."""
    at = Surroundings(torch.is_grad_enabled())
    forms = [TensorForm.of(x, recorded=at.recorded) for x in examples]
    owners = [v for v in values if hasattr(v, "__dict__") and not isinstance(v, FunctionType | type)]
    if not owners or not all(type(x) in _TENSORS for x in examples):
        raise NotImplementedError("its arguments are of a kind that has no operator")
    if not (all(x.is_cpu for x in examples) or hasattr(torch.Tag, "cudagraph_unsafe")):
        raise NotImplementedError("this torch would record it in a CUDA graph")
    bound = bound_to(owners[0])  # with which it goes
    key = name, structure, tuple(forms), at.key, tuple(v if _constant(v) else id(v) for v in values)
    objects = [NAMED.get(value, value) if isinstance(value, str) else value for value in values]
    known: GraphCall | None = bound.get(key)
    call = known or GraphCall(name, structure, objects, forms, _contents(objects), at)
    if not call.fresh():  # a first call may leave something in its objects, too
        call = GraphCall(name, structure, objects, forms, _contents(objects), at)
    bound[key] = call
    if not call.fresh():
        raise NotImplementedError("what it reads changes with every call")
    if not all(map(_constant, getattr(KNOWN, call.name)[2])):
        raise NotImplementedError("its result is no tree of tensors")
    return call


def _contents(objects: list[Any]) -> Contents:
    """Return what is to be watched of the arguments of a call."""
    contents = Contents(*map(_content, objects))
    if contents.reason is not None:
        raise NotImplementedError(f"what it reads cannot be watched: {contents.reason}")
    if not all(type(x) in _TENSORS for x in contents.tensors):
        raise NotImplementedError("it reads numbers of rows")
    return contents


def _content(value: Any) -> Any:
    """Return what is to be watched of an object."""
    if isinstance(value, CompiledMethod):
        return value.definition, value.owner
    program = value.program if isinstance(value, Prepared) else value
    return program.step if isinstance(program, Program) else program


def _guard(name: str) -> Any:
    """Return what makes the guard that objects hold and lead to what they did."""

    def unchanged(_: Any) -> bool:
        call = CALLS.get(name)
        return call is not None and call.fresh()

    def make(builder: Any, guard: Any) -> None:
        manager, text = builder.get_guard_manager(guard), [f"{name} reads what it did"]
        try:
            manager.add_lambda_guard(unchanged, text, guard.user_stack)
        except TypeError:  # torch 2.6
            manager.add_lambda_guard(unchanged, text)

    return make
