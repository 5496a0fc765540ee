"""Docstrings as the site's generator reads them: an extension of griffe."""

from __future__ import annotations

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"^Example:$", re.MULTILINE)
_LINE = re.compile(r"^( *)([^\n]*)\n(?=\1 {4,}\S)", re.MULTILINE)


class Docstrings(griffe.Extension):
    """Make `Example:` the section of examples, and put a blank line before formulas that are indented."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite the docstring of an object that was just read."""
        if obj.docstring is not None:
            obj.docstring.value = _EXAMPLE.sub("Examples:", obj.docstring.value)
