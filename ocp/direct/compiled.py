"""The derivatives of the blocks of a program, interpreted or compiled.

Libraries are those of :mod:`ocp.libraries`, kept between runs; compiled functions return the very numbers that
interpreted ones do.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import casadi as ca

from ocp.direct import assembly
from ocp.direct.assembly import SIZES, Derivatives, derivatives
from ocp.direct.fragment import Fragment
from ocp.libraries import SERIALISED, CompilerError, Library, built, code, notice, serialised

__all__ = ["block_derivatives"]

RECIPE = hashlib.sha256(Path(assembly.__file__).read_bytes()).hexdigest()
"""What tells how derivatives are made of a block: the text that does it."""


def block_derivatives(fragment: Fragment, compiled: bool) -> list[Derivatives]:
    """Return the derivatives of each block of a fragment; blocks of one function share theirs.

    Args:
        fragment: Whose blocks.
        compiled: Whether they are compiled. What cannot be is interpreted, and a warning says once why.

    Raises:
        OutOfTime: The time limit is over.
    """
    texts = [serialised(block.function) for block in fragment.blocks]
    found: dict[str, Derivatives] = {}
    for text, block in zip(texts, fragment.blocks, strict=True):
        if text not in found:
            is_compiled = compiled and _is_worth_it(block.function, text)
            found[text] = _compiled(block.function, text) if is_compiled else derivatives(block.function)
    return [found[text] for text in texts]


def _is_worth_it(function: Any, text: str) -> bool:
    """Whether a function has a text, so that it can be known again, and does more than it takes to call it."""
    is_short = function.is_a("SXFunction") and function.n_instructions() <= SIZES.called
    return text.startswith(SERIALISED) and not is_short


def _compiled(function: Any, text: str) -> Derivatives:
    """Return the derivatives of a function of this text from a library, interpreted where there can be none."""
    try:
        path = built(Library((RECIPE, text), lambda: code(derivatives(function))))
        return Derivatives(*(ca.external(name, str(path)) for name in Derivatives._fields))
    except (CompilerError, RuntimeError) as error:
        notice(str(error))
        return derivatives(function)
