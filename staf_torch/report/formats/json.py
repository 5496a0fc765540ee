"""JSON: null for what is missing, and why."""

from __future__ import annotations

from json import dumps
from typing import Any

from ..table import Table


def json_text(table: Table) -> str:
    """``{"columns": [...], "rows": [{"ball_error": null, "reasons": {"ball_error": "..."}}], "notes": []}``.

    Every digit; NaN and infinity, which JSON does not have, are null with the reason.
    """
    rows: list[dict[str, Any]] = [{**row.cells, "reasons": dict(row.reasons)} for row in table.rows]
    content = {"columns": list(table.names), "rows": rows, "notes": list(table.notes)}
    return dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
