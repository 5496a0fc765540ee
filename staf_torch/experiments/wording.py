"""One sentence for every error that a user can bring about."""

from __future__ import annotations

import re

from hydra.errors import HydraException, MissingConfigException
from omegaconf.errors import OmegaConfBaseException

USER_ERRORS = (ValueError, HydraException, OmegaConfBaseException, OSError)
"""What a setting or the disk can bring about; anything else is a defect and keeps its trace."""


def sentence(error: BaseException) -> str:
    """The library's own words where Hydra wrapped them, else the error's."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ValueError) and not isinstance(cause, OmegaConfBaseException):
            return str(cause)
        cause = cause.__cause__
    if isinstance(error, OSError) and not isinstance(error, HydraException) and error.filename:
        return f"cannot write {error.filename}: {error.strerror}"
    unknown = re.match(r"Could not override '(.+?)'", str(error))
    if unknown:
        return f"there is no setting `{unknown[1]}`; `staf --help` lists them."
    if isinstance(error, MissingConfigException) and error.options:
        name = (error.missing_cfg_file or "").removesuffix(".yaml")
        more = "; others come with the extras joblib, slurm, ray and optuna" if "hydra/" in name else ""
        return f"there is no `{name}`; there are {', '.join(error.options)}{more}."
    return str(error)


def reason(error: BaseException) -> str:
    """One line for the records: the sentence, and the type of an error that is a defect."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    said = " ".join(sentence(error).split())
    return said if isinstance(error, USER_ERRORS) and said else f"{type(error).__name__}: {said}"
