"""Native code under AddressSanitizer and UBSan; ten thousand calls: `python tests/sanitized.py`."""

from __future__ import annotations

from pathlib import Path

import pytest
import sanitized


@pytest.mark.skipif(sanitized.missing() is not None, reason=sanitized.missing() or "")
def test_no_shape_or_layout_makes_native_code_read_outside(tmp_path: Path) -> None:
    assert sanitized.run(6, 1, tmp_path).startswith("6 calls of")
