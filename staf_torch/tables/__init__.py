"""Tables of runs, and of rows that an experiment has computed. Nothing here needs torch."""

from ..results.reader import Collection as Collection
from ..results.reader import RecordedRun as RecordedRun
from ..results.reader import collect as collect
from .aggregate import Layout as Layout
from .aggregate import tabulate as tabulate
from .latex import Print as Print
from .latex import latex_text as latex_text
from .model import Style as Style
from .model import Table as Table
from .model import html_text as html_text
from .model import json_text as json_text
from .model import parquet_bytes as parquet_bytes

__all__ = [
    "Collection",
    "Layout",
    "Print",
    "RecordedRun",
    "Style",
    "Table",
    "collect",
    "html_text",
    "json_text",
    "latex_text",
    "parquet_bytes",
    "tabulate",
]
