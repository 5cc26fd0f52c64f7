"""What colours mean, in every picture: told apart with every kind of colour vision (Okabe, Ito 2008)."""

from __future__ import annotations

__all__ = ["COMPARED", "FAULT", "LIMIT", "PLAN", "SURROUNDINGS", "TIP"]

PLAN = "#0072B2"
"""Of the plan, or of the motion that is looked at."""
COMPARED = "#D55E00"
"""Of what it is compared with: the pseudo-inverse, a paper's method, another plan."""
LIMIT = "#6E6E6E"
"""Of what it must not pass; dashed."""
FAULT = "#CC79A7"
"""Of where it does."""
TIP = "#009E73"
"""Of the tip's way."""
SURROUNDINGS = "#6E6E6E"
"""Of what stands around."""
