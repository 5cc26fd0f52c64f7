"""Task paths of lines, arcs, helices and splines with tool orientation and rounded corners, given by distance."""

from models.paths.blends import gamma, gauss_newton, march, predictor_corrector, rest_to_rest
from models.paths.path import Path, fit_splines, split_at_reversals
from models.paths.rounding import smooth
from models.paths.segments import Arc, Helix, Line, Segment
from models.paths.smooth_path import Blend, PathPoint, SmoothPath, Turn, path_function, turn_function
from models.paths.splines import Spline

__all__ = [
    "Arc",
    "Blend",
    "Helix",
    "Line",
    "Path",
    "PathPoint",
    "Segment",
    "SmoothPath",
    "Spline",
    "Turn",
    "fit_splines",
    "gamma",
    "gauss_newton",
    "march",
    "path_function",
    "predictor_corrector",
    "rest_to_rest",
    "smooth",
    "split_at_reversals",
    "turn_function",
]
