"""A table as text, one format a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..table import Table
from .csv import csv_text as csv_text
from .json import json_text as json_text
from .latex import latex_text as latex_text
from .markdown import markdown_text as markdown_text
from .parquet import parquet_bytes as parquet_bytes
from .printed import Style as Style

PLAIN: Mapping[str, Callable[[Table], str]] = {"csv": csv_text, "json": json_text}
"""All columns and every digit, for programs."""
READ: Mapping[str, Callable[[Table, Style], str]] = {"md": markdown_text, "tex": latex_text}
"""For people: few digits, mean and deviation in one column."""
FORMATS = (*READ, *PLAIN, "parquet")
