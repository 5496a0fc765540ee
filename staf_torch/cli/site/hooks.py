"""Hooks of the generator: formulas of a page are typeset when it is built."""

from __future__ import annotations

from typing import Any

from staf_torch.cli.site.formulas import typeset


def on_page_content(html: str, **kwargs: Any) -> str:
    """Return the HTML of a page with its indented formulas typeset."""
    return typeset(html)
