"""`staf docs [FOLDER [MODULE ...]]`: the reference pages, made of the docstrings by pdoc (extra `docs`)."""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from collections.abc import Sequence
from pathlib import Path

from ..signs import Sign

MODULES = (
    *("staf_torch", "staf_torch.sweeps.python_api"),
    *("staf_torch.approximation.conditioning", "staf_torch.approximation.sensitivity"),
    *("staf_torch.centers", "staf_torch.deploy", "staf_torch.engine", "staf_torch.envs"),
    *("staf_torch.kernels", "staf_torch.lanes", "staf_torch.metrics", "staf_torch.online"),
    "staf_torch.tables",
)
"""What has a page; `staf_torch` brings the modules of its `__all__`: adp, optim, systems, targets, theory."""


@Sign("writing reference pages", log=False)
def main(words: Sequence[str]) -> str:
    """Write the pages into a folder, `site` where none is named; return where they begin.

    Args:
        words: the folder, then the modules that get a page, all of `MODULES` by default.

    Raises:
        ValueError: without pdoc, or for a module that has no page.
    """
    chosen = words[1:] or MODULES
    if unknown := [name for name in chosen if name not in MODULES]:
        raise ValueError(
            f"`staf docs FOLDER MODULE ...` takes modules of {', '.join(MODULES)}; got {unknown[0]!r}."
        )
    if importlib.util.find_spec("pdoc") is None:
        raise ValueError("`staf docs` needs pdoc: install the extra, pip install 'staf_torch[docs]'.")
    folder = Path(words[0] if words else "site")
    pdoc = importlib.import_module("pdoc")
    # Without the code of what is documented, which a reader has: that was four fifths of the largest page,
    # half of all, and a third of the time.
    pdoc.render.configure(docformat="google", footer_text="staf_torch", show_source=False)
    with warnings.catch_warnings():
        # Those of a NamedTuple, or of a dataclass's ancestor, are evaluated where our names are not known:
        warnings.filterwarnings("ignore", "Error parsing type annotation")  # the text is then shown as it is
        pdoc.pdoc(*chosen, output_directory=folder)
    return f"reference pages: {folder / 'index.html'}"
