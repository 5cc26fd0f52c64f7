"""A sample of the planted touches: none is proven clear, and none of the bounds is far below the depth of the touch."""

from __future__ import annotations

import pytest

from tests.sweep import touches


@pytest.mark.parametrize("kind", sorted(touches.COUNTS))
def test_no_planted_contact_is_proven_clear(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(touches, "MOTIONS", 2)
    row = touches.result(kind, 7)
    assert row["wrong"] == []
    assert row["touches"] == 20
    assert -1e-3 < row["largest_bound_m"] < 0.0
