"""Run directories, tables and figures. Import `staf_torch.report.plots` yourself: it needs matplotlib."""

from .collection import Collection as Collection
from .collection import Skipped as Skipped
from .collection import collect as collect
from .files import write_metrics as write_metrics
from .files import write_text as write_text
from .history import HistoryWriter as HistoryWriter
from .run import Run as Run
from .table import Table as Table
from .tabulate import Layout as Layout
from .tabulate import tabulate as tabulate
