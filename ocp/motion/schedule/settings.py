"""What schedules are planned with: how fine, how accurately, and how much at once."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["SETTINGS", "ScheduleSettings"]


@dataclass(frozen=True)
class ScheduleSettings:
    """How a schedule is planned. Shares are relative.

    Attributes:
        block: Places whose limits are evaluated at once: bounds the memory of a long path.
        halvings, curve_halvings: Of an interval of the first grid at most, and of one of the curve of permitted speeds,
            whose minima are sharp.
        shortest: Share of the path below which a piece counts with the next, and an interval is not halved.

        uneven, uneven_speed: Largest error of a demand between two nodes, over its limit, when it counts as even; that
            of the rows of speed, which hold at nodes alone.
        cells, segments: Intervals of the first grid in each cell of a blend, and on all segments together at least.
        closest: Ratio of neighbouring intervals below which their node goes, unless pieces meet there.
        build_up, ramp: Duration of an interval over the time in which the acceleration builds up, or over that in which
            the top speed is reached, if that is more.
        turn, least_build_up: But no more than this share of the time of the ramp, for the speed must not change much in
            an interval; nor less than this share of the build-up, for with low jerks no motion gets near the limits of
            acceleration.
        parts: Most intervals that one which resolves the limits is cut into.
        growth: Ratio of neighbouring distances from rest, where the speed grows as their power 2/3.
        first: Duration of the first and last interval, of constant jerk, over that of the build-up.

        room: Share of the limits that is left for what lies between the places where rows are held: half of what
            schedules promise to keep limits to, 1e-3.
        bend: Share of the limits by which a demand may bend away from a parabola before more places are looked at.
        looked: Share of a bound used at one of three places above which the vertex between them is evaluated: a
            parabola exceeds the greatest of three values by a quarter at most.
        fine: Parts of an interval at whose ends demands are evaluated where they bend; the middle is one of them.

        rounds: Of tightening.
        accuracies: Of the time of a window, relative, round by round: no more than rows still change by; the last is
            for all later rounds.
        lowered: Largest ratio by which a bound is lowered in a round.
        around, few: Intervals on either side of one that passes a limit, which are planned again with it; they alone if
            they are no more than this share of all.
        window, overlap: Intervals of a window, which bounds the memory, and those at its end that the next one plans
            again.
        seam: Share of the bounds that a window uses behind its seam, so that the next has room.
        binding: A limit binds where more than this share of it is used; rows that reach less whatever the motion are
            left out at first.
        near: Once a motion is known, rows that came less near to their bound in an interval and beside it are left out.
        start, again: Squared speed to start from, over that of a fastest steady motion that accelerates as it may; and
            over that of a solution of a similar program. again_inside: Over that, where this leads nowhere.
        center, center_again: Complementarity over the time that the interior point begins with there.
        dive: Squared speed inside an interval over that at its beginning at least, where a rough spline dives.

        reached: Share of the asked speed below which a motion must be to count as slowed.
        leaving: Share of the asked speed that a motion may be slower near the ends of a stretch that is long enough.
        long_path: Pieces from which on a path with centripetal limits alone is slowed by ramps, which take a fiftieth
            of the work.
        speed_error: Relative error of the permitted speed between two places of its curve, which is kept back.
        speed_change: Largest relative change of it between two places; the lower one counts for what lies between.
        spread: A stretch of one speed spans permitted speeds up to this ratio.
        zone_rounds, thorough_from: Rounds after which no plan is found, and after which every place gets its own speed.
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
    looked: float = 0.75
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
