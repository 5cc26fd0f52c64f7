"""Settings of the schedules: resolution, accuracy, and sizes of blocks."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["SETTINGS", "ScheduleSettings"]


@dataclass(frozen=True)
class ScheduleSettings:
    """Settings of the schedules. Shares are relative.

    Attributes:
        block: Places whose limits are evaluated at once, which bounds the memory of a long path.
        halvings, curve_halvings: Largest number of halvings of an interval of the first grid, and of one of the
            velocity curve, whose minima are sharp.
        shortest: Share of the path below which a segment is merged with the next, and an interval is not halved.

        uneven, uneven_speed: Largest interpolation error of a row between two nodes, over its limit; that of the rows
            of speed, which are enforced at nodes only.
        cells, segments: Intervals of the first grid in each cell of a blend, and at least on all segments together.
        closest: Ratio of neighbouring intervals below which their node is dropped, unless segments meet there.
        build_up, ramp: Duration of an interval over the time in which the acceleration builds up, or, if longer, over
            that in which the top speed is reached.
        turn, least_build_up: Upper bound as a share of the ramp time, since the speed must not change much in an
            interval; lower bound as a share of the build-up, since with low jerks no motion gets near the acceleration
            limits.
        parts: Largest number of parts into which an interval that resolves the limits is split.
        growth: Ratio of neighbouring distances from rest, where the speed grows as their power 2/3.
        first: Duration of the first and last interval, of constant jerk, over that of the build-up.

        room: Share of the limits reserved for what happens between the places where rows are enforced: half of the
            promised accuracy of 1e-3.
        bend: Share of the limits by which a row may deviate from a parabola before more places are evaluated.
        vertex_usage: Share of a bound used at one of three places above which the vertex between them is evaluated: a
            parabola exceeds the greatest of three values by a quarter at most.
        fine: Parts into which an interval is split for that evaluation; even, so that the middle is an end of one.

        rounds: Largest number of rounds of tightening.
        accuracies: Relative accuracy of the time of a window in each round, no finer than the rows still change; the
            last value serves all later rounds.
        lowered: Largest factor by which a bound is lowered in a round.
        around, few: Intervals on either side of a violated one that are planned again with it; only these are planned
            if their share is at most `few`.
        window, overlap: Intervals of a window, which bounds the memory, and those at its end that the next one plans
            again.
        seam: Share of the bounds that a window uses behind its seam, so that the next one has freedom.
        binding: Share of a limit above which it counts as active; rows that stay below it in every motion are left out
            at first.
        near: Once a motion is known, rows that use less than this share in an interval and beside it are left out.
        start, again: Initial squared speed over that of a fastest steady motion with bounded acceleration, and over
            that of the solution of a similar program.
        again_inside: Further factor if that start fails.
        center, center_again: Initial complementarity over the time for these starts.
        dive: Least squared speed inside an interval over that at its beginning, for rough splines.

        reached: Relative reduction of the requested speed above which a motion counts as slower.
        leaving: Relative reduction accepted near the ends of a stretch that is long enough.
        long_path: Number of segments from which a path with centripetal limits alone uses ramps, at a fiftieth of the
            work.
        speed_error: Relative error of the permitted speed between two places of the velocity curve, which is
            subtracted.
        speed_change: Largest relative change of it between two places; the lower value holds between them.
        spread: Largest ratio of permitted speeds in a stretch of one speed.
        zone_rounds, thorough_from: Largest number of rounds, and the round from which every place gets its own speed.
    """

    block: int = 20_000
    halvings: int = 8
    curve_halvings: int = 12
    shortest: float = 1e-7

    uneven: float = 0.2
    uneven_speed: float = 0.02
    cells: int = 4
    segments: int = 64
    closest: float = 0.05
    build_up: float = 0.5
    ramp: float = 0.05
    turn: float = 0.25
    least_build_up: float = 0.05
    parts: int = 32
    growth: float = 1.2
    first: float = 0.3

    room: float = 5e-4
    bend: float = 1e-4
    vertex_usage: float = 0.75
    fine: int = 16

    rounds: int = 20
    accuracies: tuple[float, ...] = (0.05, 1e-3, 1e-5, 1e-8)
    lowered: float = 1.5
    around: int = 40
    few: float = 1 / 6
    window: int = 2000
    overlap: int = 200
    seam: float = 0.999
    binding: float = 0.98
    near: float = 0.9
    start: float = 0.5
    again: float = 0.9
    again_inside: float = 0.3
    center: float = 1.0
    center_again: float = 0.1
    dive: float = 0.01

    reached: float = 1e-4
    leaving: float = 1e-5
    long_path: int = 400
    speed_error: float = 2e-4
    speed_change: float = 0.1
    spread: float = 1.2
    zone_rounds: int = 200
    thorough_from: int = 40


SETTINGS = ScheduleSettings()
