"""The sheet as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def markdown(sheet: Mapping[str, Any]) -> str:
    """The sheet of `staf-export`, for reading.

    Args:
        sheet: as in the JSON beside it.
    """
    work, late = sheet["work"], sheet["latency"]
    ports = [
        f"| {way} | `{port['name']}` | {_shape(port['size'])} "
        f"| {sheet['dtype']} | {port['unit']} | {port['region']} |"
        for way in ("input", "output")
        for port in sheet[way + "s"]
    ]
    errors = [
        f"| `{name}` | {sheet['equality'][name]:.2g} | {sheet['float32_error'][name]:.2g} |"
        for name in sheet["equality"]
    ]
    lines = [
        f"# {sheet['file']}",
        "",
        sheet["what"],
        "",
        f"From `{sheet['run']}`, trajectory {sheet['row']}, by staf_torch {sheet['version']} and torch "
        f"{sheet['torch']}. Batch B: {sheet['batch']}.",
        "",
        "| | name | shape | dtype | unit | region |",
        "|---|---|---|---|---|---|",
        *ports,
        "",
        "| a call with one row | |",
        "|---|---|",
        f"| constants | {work['parameters']} ({work['bytes_constants']} bytes) |",
        f"| flops | {work['flops']}, and {work['functions']} calls of exp, sin, ... |",
        f"| bytes | {work['bytes_constants'] + work['bytes_in_out']}: constants, input and output once |",
        f"| latency, median | {late['median_us']:.1f} us |",
        f"| latency, 99 % | {late['p99_us']:.1f} us |",
        f"| latency, worst of {late['calls']} | {late['worst_us']:.1f} us |",
        "",
        f"Latency: from Python, {sheet['runtime']}, one core of {sheet['machine']}.",
        "",
        "| output | file against library, same dtype | float32 against float64 |",
        "|---|---|---|",
        *errors,
        "",
        "Errors are the largest difference over the largest value, at 1000 random points of the region.",
    ]
    return "\n".join(lines) + "\n"


def _shape(size: int | None) -> str:
    return "(B,)" if size is None else f"(B, {size})"
