"""The one exception of the package."""

from __future__ import annotations


class ModelError(ValueError):
    """A machine that cannot exist or a request that does not fit it.

    The message names the offending link, joint or argument, its value, and what to do about it.
    """
