"""Run directories, tables and figures. Import `staf_torch.report.plots` yourself: it needs matplotlib."""

from .files import write_metrics as write_metrics
from .files import write_text as write_text
from .history import HistoryWriter as HistoryWriter
