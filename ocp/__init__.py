"""Optimal control: declare a problem, transcribe it, solve it, audit it."""

from ocp.audit.audit import Audit, Finding
from ocp.audit.certificate import Certificate, certificate
from ocp.direct.collocation import Collocation
from ocp.direct.shooting import MultipleShooting
from ocp.errors import AuditError, ProblemError, RefinementWarning, SolveError
from ocp.indirect.method import Indirect
from ocp.methods import prepare, solve
from ocp.problem.problem import Problem
from ocp.refinement import refine
from ocp.solution import Solution
from ocp.tightening import tighten

__all__ = [
    "Audit",
    "AuditError",
    "Certificate",
    "Collocation",
    "Finding",
    "Indirect",
    "MultipleShooting",
    "Problem",
    "ProblemError",
    "RefinementWarning",
    "Solution",
    "SolveError",
    "certificate",
    "prepare",
    "refine",
    "solve",
    "tighten",
]
