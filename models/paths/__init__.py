"""Task paths: lines and arcs with tool orientation, rounded at their corners, as functions of the distance."""

from models.paths.blends import end_curvature, gamma, middle_curvature, peak_curvature
from models.paths.chain import Path
from models.paths.function import path_function, turn_function
from models.paths.mapping import gauss_newton, march, predictor_corrector
from models.paths.segments import Arc, Line, Segment
from models.paths.smooth import Blend, Place, SmoothPath, Turn
from models.paths.smoothing import smooth

__all__ = [
    "Arc",
    "Blend",
    "Line",
    "Path",
    "Place",
    "Segment",
    "SmoothPath",
    "Turn",
    "end_curvature",
    "gamma",
    "gauss_newton",
    "march",
    "middle_curvature",
    "path_function",
    "peak_curvature",
    "predictor_corrector",
    "smooth",
    "turn_function",
]
