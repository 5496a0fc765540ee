"""JSON: null for what is missing, and why."""

from __future__ import annotations

import math
from json import dumps
from typing import Any

from ..table import Row, Table


def json_text(table: Table) -> str:
    """``{"columns": [...], "rows": [{"ball_error": null, "reasons": {"ball_error": "..."}}], "notes": []}``.

    Every digit; NaN and infinity, which JSON does not have, are null with the reason.
    """
    content = {
        "columns": list(table.names),
        "rows": [_row(row) for row in table.rows],
        "notes": list(table.notes),
    }
    return dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _row(row: Row) -> dict[str, Any]:
    lost = {n: v for n, v in row.cells.items() if isinstance(v, float) and not math.isfinite(v)}
    reasons = {**row.reasons, **{name: f"{value!r} is not a JSON number" for name, value in lost.items()}}
    return {**row.cells, **dict.fromkeys(lost), "reasons": reasons}
