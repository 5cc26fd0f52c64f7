"""Tables, summary and printed report of the captive trajectory paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scripts.papers.cts.plan import plan_summary
from scripts.papers.cts.results import NOTE, PAPER_TIMES, REFERENCE, Results
from scripts.papers.run import Content, Row, Table, compared, text_table

TIME_NOTE = (
    "Rows 'jacobian' and 'combined': arithmetic alone, mapped steps times iterations. A call from Python costs 20 to "
    "30 us whatever it computes, more than any of these steps: called from Python the ratio of the two methods shrinks "
    "towards that of their numbers of calls (time_ratio_in_python). Compiled rows are free of it."
)


def files(results: Results) -> Mapping[str, Content]:
    """What is written beside the figures."""
    return {
        "table6_time.csv": Table(time_table(results)),
        "iterations.csv": Table(method_table(results)),
        "reference_rolls.csv": Table(reference_table(results)),
        "sweep.csv": Table(sweep_table(results)),
        "summary.json": summary(results),
    }


def report(results: Results) -> str:
    """Paper value, our value and the difference, and every table."""
    result, plan = results.release, plan_summary(results.plan)
    parts = [
        f"Table 6, time of 200 targets\n{text_table(time_table(results), 4)}\n{TIME_NOTE}",
        "Iterations\n" + text_table(method_table(results), 4),
        "Reference rolls\n" + text_table(reference_table(results), 8),
        "Random targets\n" + text_table([results.random], 4),
        f"Store release: tracked to {result.tracking[:, 0].max():.1e} m, {result.tracking[:, 1].max():.1e} rad;\n"
        f"least clearance {result.clearance.min():.4f} m, {result.nearest[0]} to {result.nearest[1]}",
        "Whole sweep planned at once\n"
        + text_table([plan["plan"], plan["each_target_by_itself"]], 4)
        + f"\n{results.plan.audit}",
    ]
    if results.nanoseconds:
        parts.append("Compiled, ns a target: " + ", ".join(f"{k} {v:.0f}" for k, v in results.nanoseconds.items()))
    return "\n\n".join([*parts, NOTE])


def time_table(results: Results) -> list[Row]:
    """Table 6: the paper's machine and code are not ours, only the ratio compares."""
    ours = {"jacobian": results.arithmetic["jacobian, gain 20"], "combined": results.arithmetic["combined"]}
    ratio, own = PAPER_TIMES["jacobian"] / PAPER_TIMES["combined"], ours["jacobian"] / ours["combined"]
    rows: list[Row] = [
        *({"what": f"{name}, s", **compared(PAPER_TIMES[name], seconds)} for name, seconds in ours.items()),
        {"what": "ratio", **compared(ratio, own)},
        {"what": "closed form from Python, s", **compared(float("nan"), results.seconds["i1 closed form"])},
    ]
    if results.nanoseconds:
        seconds = 200e-9 * results.nanoseconds["closed form, reach"]
        rows.append({"what": "compiled, s", **compared(PAPER_TIMES["combined"], seconds)})
    return rows


def method_table(results: Results) -> list[Row]:
    """Iterations and convergence of the iterations, by index, method and gain."""
    return [
        {
            "index": name,
            "method": method,
            "gain": gain,
            "iterations_mean": float(run.iterations.mean()),
            "iterations_max": int(run.iterations.max()),
            "converged": int(run.converged.sum()),
            "of": len(run.iterations),
            "gain_n6_squared_bend_max": results.stability.get((name, gain), 0.0),
        }
        for (name, method, gain), run in results.runs.items()
    ]


def reference_table(results: Results) -> list[Row]:
    """Reference rolls, known from an independent computation."""
    return [
        {
            "z_in": z,
            "reference_rad": known,
            "ours_rad": results.reference[z],
            "difference": results.reference[z] - known,
        }
        for z, known in REFERENCE.items()
    ]


def sweep_table(results: Results) -> list[Row]:
    """Joints of the global optimum over the sweep."""
    table = results.optimal["i1"]
    names = ("q1_m", "q2_rad", "q3_rad", "q4_rad", "q5_rad", "q6_rad")
    return [
        {"z_m": row[2], **dict(zip(names, q, strict=True)), "active": active, "status": status}
        for row, q, active, status in zip(table.targets, table.joints, table.active, table.status, strict=True)
    ]


def summary(results: Results) -> dict[str, Any]:
    """The numbers that matter."""
    kept = ("iterations_mean", "iterations_max", "converged", "gain", "gain_n6_squared_bend_max")
    methods = {
        (row["index"], row["method"], row["gain"]): {name: row[name] for name in kept} for row in method_table(results)
    }
    result, seconds, arithmetic = results.release, results.seconds, results.arithmetic
    content: dict[str, Any] = {
        "paper": {
            "source": "Lee, Lee 2017: kinematics of a captive trajectory simulation system",
            "table6_s": PAPER_TIMES,
        },
        "assumptions": [NOTE],
        "phi_reference": list(results.reference.values()),
        **{
            index: {
                "combined": methods[index, "combined", 0.0],
                "jacobian": methods[index, "jacobian", 20.0],
                "jacobian_gain_1": methods[index, "jacobian", 1.0],
            }
            for index in ("i1", "i2")
        },
        "newton_maximum_share": results.random["newton_maximum_share"],
        "global_missed": results.random["global_missed"],
        "random_targets": results.random,
        "time_ratio_jacobian_over_combined": arithmetic["jacobian, gain 20"] / arithmetic["combined"],
        "time_ratio_jacobian_over_combined_gain_1": arithmetic["jacobian, gain 1"] / arithmetic["combined"],
        "time_ratio_in_python": seconds["i1 jacobian, gain 20"] / seconds["i1 combined"],
        "arithmetic_seconds_of_200_targets": arithmetic,
        "seconds_of_200_targets": seconds,
        "release": {
            "seconds": float(result.t[-1]),
            "tracking_m": result.tracking[:, 0].max(),
            "tracking_rad": result.tracking[:, 1].max(),
            "least_clearance_m": result.clearance.min(),
            "nearest": list(result.nearest),
            "roll_range_rad": float(np.ptp(result.table.joints[:, 5])),
        },
        "plan": plan_summary(results.plan),
        "table6_note": TIME_NOTE,
    }
    if results.nanoseconds:
        reach = results.nanoseconds["closed form, reach"]
        content["compiled_ns_per_target"] = results.nanoseconds["closed form, limits off"]
        content["compiled_ns_per_target_in_reach"] = reach
        content["paper_time_over_compiled"] = PAPER_TIMES["combined"] / (200e-9 * reach)
    return content
