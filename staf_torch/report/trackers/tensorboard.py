"""TensorBoard event files."""

from __future__ import annotations

import importlib.util

from ..run import Run
from .base import Tracker

_FOLDER = "tensorboard"


class TensorBoardTracker(Tracker):
    """The metrics as scalars and the settings as hyperparameters, in `tensorboard/` of the run directory.

    Raises:
        ValueError: without TensorBoard.
    """

    def __init__(self) -> None:
        if importlib.util.find_spec("tensorboard") is None:
            raise ValueError(
                "`tracker=tensorboard` needs TensorBoard: install the extra, "
                "pip install 'staf_torch[tensorboard]'."
            )

    def record(self, run: Run) -> None:
        """One event file; a metric without a number is left out."""
        from torch.utils.tensorboard import SummaryWriter
        from torch.utils.tensorboard.summary import hparams

        folder = run.directory / _FOLDER
        numbers = {name: float(value) for name, value in run.metrics.items() if value is not None}
        known = {
            key: value if isinstance(value, bool | int | float | str) else str(value)
            for key, value in (run.settings or run.overrides).items()
            if value is not None
        }
        with SummaryWriter(str(folder if run.member is None else folder / str(run.member))) as writer:
            for summary in hparams(known, numbers):
                writer._get_file_writer().add_summary(summary)
            for name, number in numbers.items():
                writer.add_scalar(name, number)
