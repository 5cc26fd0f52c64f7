"""The end of a solve: one enumeration for all solvers."""

from __future__ import annotations

from enum import Enum

__all__ = ["SolverStatus"]


class SolverStatus(Enum):
    """The end of a solve. The value is IPOPT's word if IPOPT has one; files store it."""

    SOLVED = "Solve_Succeeded"
    ACCEPTABLE = "Solved_To_Acceptable_Level"
    INFEASIBLE = "Infeasible_Problem_Detected"
    ITERATION_LIMIT = "Maximum_Iterations_Exceeded"
    TIME_LIMIT = "Maximum_WallTime_Exceeded"
    INTERRUPTED = "User_Requested_Stop"
    RESTORATION_FAILED = "Restoration_Failed"
    DIVERGING = "Diverging_Iterates"
    NOT_FINITE = "Invalid_Number_Detected"
    SMALL_STEP = "Search_Direction_Becomes_Too_Small"
    TOO_FEW_VARIABLES = "Not_Enough_Degrees_Of_Freedom"
    STEP_FAILED = "Error_In_Step_Computation"
    REJECTED = "Rejected"
    """The solver found a point that a later check rejected; the message gives the reason."""
    FAILED = "Failed"
    """Any other end; the message holds the solver's own word."""

    @classmethod
    def of_word(cls, word: str) -> SolverStatus:
        """Return the status whose value is a solver's word, FAILED for any other word."""
        return cls(word) if word in cls._value2member_map_ else cls.FAILED

    @property
    def is_success(self) -> bool:
        """Return whether the solver reports an optimum."""
        return self in (SolverStatus.SOLVED, SolverStatus.ACCEPTABLE)

    @property
    def message(self) -> str:
        """Return the value with advice on what to try next; "" for a success."""
        if self.is_success:
            return ""
        return f"{self.value}: {ADVICE[self]}" if self in ADVICE else self.value

    def __str__(self) -> str:
        """Return the value."""
        return self.value


ADVICE = {
    SolverStatus.INFEASIBLE: "no point near the guess meets all constraints; relax the ones named below, "
    "lengthen the horizon or start from another guess",
    SolverStatus.ITERATION_LIMIT: "raise options={'max_iter': ...}, or start from a better guess",
    SolverStatus.TIME_LIMIT: "raise time_limit, or start from a better guess",
    SolverStatus.INTERRUPTED: "interrupted",
    SolverStatus.RESTORATION_FAILED: "start from a better guess, or scale states and constraints nearer to 1",
    SolverStatus.DIVERGING: "the cost may be unbounded below; bound the controls or add a term to the cost",
    SolverStatus.NOT_FINITE: "a function is not finite at an iterate; keep the states away from where it is singular",
    SolverStatus.SMALL_STEP: "the problem may be badly scaled or its constraints redundant",
    SolverStatus.TOO_FEW_VARIABLES: "there are more equations than unknowns; drop redundant constraints",
    SolverStatus.STEP_FAILED: "constraints may be redundant or a function not smooth",
}
