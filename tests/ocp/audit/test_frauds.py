"""Saved plans of five kinds with edits: any edit beyond its tolerance fails or is rejected by name.

Edits are coherent where they can be: a curve that is changed is reported as changed. Sizes are shares of the spread of
what is edited along the plan: edits of ``FRAUD`` are found, those of ``ROUNDING`` pass, and between the two nothing is
claimed; values of a single node count ten times less. Nothing but the package's own exceptions is raised.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import FixedBase, Robot
from ocp import Collocation, Indirect, Problem, ProblemError, Solution, TipTask, minimum_velocity_problem, solve
from ocp.curves import PiecewisePolynomial
from tests.ocp.audit.drawn import holds
from tests.ocp.problems import Array, double_integrator

pytestmark = pytest.mark.xdist_group("frauds")  # one process, so that every plan is solved once

FRAUD = {"states": 0.05, "controls": 0.05, "costates": 0.2}
"""Of the spread of each thing. Costates move nothing: what they are off by counts by the cost that they misjudge."""
ROUNDING = 1e-9

Edit = Callable[[Solution], Solution]
CURVES = {"states": "state_interpolant", "controls": "control_interpolant", "costates": "costate_interpolant"}


# ---- the plans -------------------------------------------------------------------------------------------------------


def panda() -> Solution:
    """A Panda whose hand goes straight, at the least joint rates."""
    urdf = next(file.locate() for file in files("example-robot-data") or [] if file.name == "panda.urdf")
    robot = Robot.from_urdf(urdf, tip="panda_hand_tcp", lock={"panda_finger_joint1": 0.02})
    start = [0.0, -0.6, 0.1, -2.2, 0.2, 1.7, 0.7]
    task = TipTask(rows=(3, 4, 5), velocity=[0.1, 0.12, -0.06])
    return solve(minimum_velocity_problem(FixedBase(robot), task, 2.0, start=start), Collocation(8, 4))


def bounded() -> Solution:
    """Bryson and Denham's: a state follows its bound over a third of the time."""
    problem, _, _, u = double_integrator("Bryson-Denham", (0.0, 1.0), (0.0, -1.0), ceiling=1 / 9)
    problem.minimize(running=u**2 / 2)
    return solve(problem, Collocation(12))


def fastest() -> Solution:
    """The least time, with its switch on a node."""
    problem, *_ = double_integrator("fastest", horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=10.0, guess=3.0))
    return solve(problem, Collocation(12, control="held"))


def walled() -> Solution:
    """Least effort under a mixed inequality that is met, and one of the states that is not; with a parameter."""
    problem, q, v, u = double_integrator("mixed")
    price = problem.parameter("price")
    problem.path("mixed", u - 4 * q, upper=3.0)
    problem.path("speed", v, upper=4.0)
    problem.minimize(running=price * u**2 / 2)
    return solve(problem, Collocation(48), parameters={"price": 2.0})


def indirect() -> Solution:
    """Braking against drag, by the minimum principle; its states have sizes of their own."""
    problem = Problem("braking")
    v, path = problem.state("v", initial=1.0), problem.state("way", initial=0.0, terminal=60.0)
    u = problem.control("u")
    problem.dynamics(v, u - v**2)
    problem.dynamics(path, 100 * v)
    problem.horizon(1.0)
    problem.minimize(v**2 + u**2)
    return solve(problem, Indirect())


PLANS = {"panda": panda, "bounded": bounded, "fastest": fastest, "walled": walled, "indirect": indirect}
every_plan = pytest.mark.parametrize("kind", PLANS)


@cache
def plan(kind: str) -> Solution:
    return PLANS[kind]()


# ---- edits -----------------------------------------------------------------------------------------------------------


def reported(solution: Solution, pool: str, curve: PiecewisePolynomial) -> Solution:
    """The plan with another curve, which its reported values follow."""
    values, offset = curve(solution.t / solution.horizon), 0
    by_name: dict[str, Array] = {}
    for name, old in getattr(solution, pool).items():
        by_name[name] = values[:, offset : offset + old.shape[1]]
        offset += old.shape[1]
    changes: dict[str, Any] = {pool: by_name, CURVES[pool]: curve}
    return replace(solution, **changes)


def on_values(pool: str, change: Any) -> Edit:
    """An edit of the values (N, d, n) of a curve, given their spreads (n,)."""

    def edit(solution: Solution) -> Solution:
        curve = getattr(solution, CURVES[pool])
        spread = np.ptp(curve.values.reshape(-1, curve.values.shape[2]), axis=0)
        spread = np.maximum(spread, 1e-3 * spread.max())
        size = np.abs(curve.values).max(axis=(0, 1))
        spread = np.where(spread > 0, spread, np.where(size > 0, size, 1.0))
        return reported(solution, pool, replace(curve, values=change(curve.values.copy(), spread)))

    return edit


def at(values: Array, where: Any, amount: Any) -> Array:
    values[where] = values[where] + amount
    return values


def noise(values: Array, size: Array, seed: int = 0) -> Array:
    return np.asarray(values + size * np.random.default_rng(seed).uniform(-1, 1, size=values.shape))


def changes(share: float) -> dict[str, Callable[[Array, Array], Array]]:
    """Edits of a share of the spread."""
    return {
        "shifted": lambda v, s: v + share * s,
        "scaled": lambda v, s: v * (1 + share * s / np.maximum(np.abs(v).max(axis=(0, 1)), 1e-300)),
        "one interval shifted": lambda v, s: at(v, len(v) // 2, 2 * share * s),
        "one value shifted": lambda v, s: at(v, (len(v) // 3, v.shape[1] // 2), 10 * share * s),
        "noisy": lambda v, s: noise(v, 2 * share * s),
        "leaning": lambda v, s: v + share * s * np.linspace(0, 2, len(v))[:, None, None],
        "rippled": lambda v, s: v + 2 * share * s * (-1.0) ** np.arange(len(v))[:, None, None],
    }


GROSS: dict[str, Callable[[Array, Array], Array]] = {
    "reversed": lambda v, s: v[::-1, ::-1],
    "negated and shifted": lambda v, s: -v + s,
    "constant": lambda v, s: 0 * v + v[0, 0] + s / 2,
    "nothing": lambda v, s: np.where(np.abs(v) > 0, 0.0, s),
    "not a number": lambda v, s: at(v, (2, 0), np.nan),
    "infinite": lambda v, s: at(v, (1, 0), np.inf),
    "huge": lambda v, s: at(v, (1, 0), 1e200),
}


def swapped_columns(pool: str) -> Edit:
    """Two of what a curve holds change places, and their reports stay; the last of one entry with itself doubled."""

    def edit(solution: Solution) -> Solution:
        curve = getattr(solution, CURVES[pool])
        values = curve.values[..., ::-1] if curve.values.shape[2] > 1 else 2 * curve.values
        changes: dict[str, Any] = {CURVES[pool]: replace(curve, values=values)}
        return replace(solution, **changes)

    return edit


def swapped_names(pool: str) -> Edit:
    """The arrays of two names change places; of one name its entries or its times."""

    def edit(solution: Solution) -> Solution:
        old = getattr(solution, pool)
        names, arrays = list(old), list(old.values())
        if len(names) > 1:
            arrays = arrays[::-1]
        else:
            arrays = [arrays[0][:, ::-1] if arrays[0].shape[1] > 1 else arrays[0][::-1] + 0.1]
        changes: dict[str, Any] = {pool: dict(zip(names, arrays, strict=True))}
        return replace(solution, **changes)

    return edit


def part(curve: str, **changes: Callable[[Array], Any]) -> Edit:
    """An edit of the breaks, nodes or values of a curve, whose reports stay."""

    def edit(solution: Solution) -> Solution:
        old = getattr(solution, curve)
        new = {name: change(getattr(old, name)) for name, change in changes.items()}
        changed: dict[str, Any] = {curve: replace(old, **new)}
        return replace(solution, **changed)

    return edit


def field(name: str, change: Any) -> Edit:
    """An edit of one attribute by a function of it."""

    def edit(solution: Solution) -> Solution:
        changed: dict[str, Any] = {name: change(getattr(solution, name))}
        return replace(solution, **changed)

    return edit


def stretched(factor: float) -> Edit:
    """Another horizon, with its times."""
    return lambda solution: replace(solution, horizon=factor * solution.horizon, t=factor * solution.t)


def frauds() -> Iterator[tuple[str, Edit]]:
    """Every edit by a name that says it."""
    for pool in CURVES:
        for name, change in {**changes(FRAUD[pool]), **GROSS}.items():
            yield f"{pool} {name}", on_values(pool, change)
        yield f"{pool} swapped in their curve", swapped_columns(pool)
        yield f"{pool} swapped by name", swapped_names(pool)
        yield (
            f"{pool} reported otherwise",
            field(pool, lambda d: {n: v + 0.05 * (np.ptp(v) or 1) for n, v in d.items()}),
        )
        yield f"{pool} reported late", field(pool, lambda d: {n: np.roll(v, 2, axis=0) + 1e-3 for n, v in d.items()})
        curve = CURVES[pool]
        yield f"{pool}: one row less", field(pool, lambda d: {n: v[1:] for n, v in d.items()})
        yield f"{pool}: flat arrays", field(pool, lambda d: {n: v.ravel() for n, v in d.items()})
        yield f"{pool}: words", field(pool, lambda d: {n: v.astype(str) for n, v in d.items()})
        yield f"{pool}: complex", field(pool, lambda d: {n: v + 1j for n, v in d.items()})
        yield f"{pool}: a name too many", field(pool, lambda d: {**d, "more": next(iter(d.values()))})
        yield f"{pool}: a name missing", field(pool, lambda d: dict(list(d.items())[1:]))
        yield f"{pool}: another name", field(pool, lambda d: {f"{n}'": v for n, v in d.items()})
        yield f"{pool}: one column more", field(pool, lambda d: {n: np.hstack([v, v[:, :1]]) for n, v in d.items()})
        yield (
            f"{pool}: nan reported",
            field(pool, lambda d: {n: np.where(np.arange(len(v))[:, None] == 3, np.nan, v) for n, v in d.items()}),
        )
        yield f"{curve}: breaks beyond 1", part(curve, breaks=lambda b: 1.2 * b)
        yield f"{curve}: breaks below 0", part(curve, breaks=lambda b: b - 0.1)
        yield f"{curve}: breaks backwards", part(curve, breaks=lambda b: b[::-1])
        yield f"{curve}: breaks crossed", part(curve, breaks=lambda b: b[[0, 2, 1, *range(3, len(b))]])
        yield f"{curve}: a break twice", part(curve, breaks=lambda b: np.insert(b, 2, b[2])[:-1])
        yield f"{curve}: breaks moved", part(curve, breaks=lambda b: b**1.3)
        yield f"{curve}: breaks nan", part(curve, breaks=lambda b: np.where(np.arange(len(b)) == 1, np.nan, b))
        yield f"{curve}: breaks as words", part(curve, breaks=lambda b: b.astype(str))
        yield f"{curve}: a break less", part(curve, breaks=lambda b: b[:-1])
        yield f"{curve}: nodes beyond 1", part(curve, nodes=lambda n: n + 1.0)
        yield f"{curve}: nodes nan", part(curve, nodes=lambda n: n * np.nan)
        yield f"{curve}: a node less", part(curve, nodes=lambda n: n[1:])
        yield f"{curve}: pieces swapped", part(curve, values=lambda v: at_swapped(v))
        yield f"{curve}: a piece less", part(curve, values=lambda v: v[:-1])
        yield f"{curve}: flat values", part(curve, values=lambda v: v.ravel())
        yield f"{curve}: a column more", part(curve, values=lambda v: np.concatenate([v, v[..., :1]], axis=2))
    costs: dict[str, Any] = {
        "a hundredth cheaper": lambda c: 0.99 * c,
        "a hundredth dearer": lambda c: 1.01 * c,
        "negative": lambda c: -c,
        "nothing": lambda c: 0.0,
        "nan": lambda c: np.nan,
        "infinite": lambda c: np.inf,
        "a word": lambda c: "cheap",
        "none": lambda c: None,
        "complex": lambda c: c + 1j,
        "a list": lambda c: [c],
        "true": lambda c: True,
    }
    for name, change in costs.items():
        yield f"cost {name}", field("cost", change)
    for name, factor in {
        "longer": 1.02,
        "shorter": 0.98,
        "twice": 2.0,
        "nothing": 0.0,
        "negative": -1.0,
        "nan": np.nan,
    }.items():
        yield f"horizon {name}", field("horizon", lambda h, f=factor: f * h)
        yield f"horizon {name}, with its times", stretched(factor)
    for name, value in {"infinite": np.inf, "a word": "1", "none": None, "true": True}.items():
        yield f"horizon {name}", field("horizon", lambda h, v=value: v)
    times: dict[str, Any] = {
        "scaled": lambda t: 1.02 * t,
        "late": lambda t: t + 0.02,
        "backwards": lambda t: t[::-1],
        "from the end": lambda t: t[-1] - t,
        "nan": lambda t: np.where(np.arange(len(t)) == 2, np.nan, t),
        "crossed": lambda t: t[[0, 2, 1, *range(3, len(t))]],
        "too few": lambda t: t[:-1],
        "too many": lambda t: np.append(t, 2 * t[-1]),
        "beyond the end": lambda t: np.append(t[:-1], 1.5 * t[-1]),
        "words": lambda t: t.astype(str),
        "in columns": lambda t: t[:, None],
        "uneven": lambda t: t[-1] * (t / t[-1]) ** 1.5,
        "nothing": lambda t: t[:0],
    }
    for name, change in times.items():
        yield f"times {name}", field("t", change)
    for word in (False, "no", "yes", None, 1, 0, "True", [True]):
        yield f"success {word!r}", field("success", lambda _, w=word: w)
    yield "parameters: one too many", field("parameters", lambda d: {**d, "more": np.ones(1)})
    yield "parameters as a list", field("parameters", lambda d: [1.0])
    yield "states as a list", field("states", lambda d: list(d.values()))
    yield "no states", field("states", lambda d: {})
    yield "no controls", field("controls", lambda d: {})


def at_swapped(values: Array) -> Array:
    """Two pieces change places; where they are alike, another one is negated."""
    values = values.copy()
    i, j = 1, len(values) - 2
    if np.abs(values[i] - values[j]).max() < 0.05 * np.abs(values).max():
        values[i] = -values[i] + np.abs(values).max()
    values[[i, j]] = values[[j, i]]
    return values


FRAUDS = dict(frauds())
FOR_ONE: dict[str, dict[str, Edit]] = {
    "walled": {
        "another price": field("parameters", lambda d: {"price": 1.05 * d["price"]}),
        "a price of nan": field("parameters", lambda d: {"price": d["price"] * np.nan}),
        "no price": field("parameters", lambda d: {}),
        "a word for a price": field("parameters", lambda d: {"price": "two"}),
        "two prices": field("parameters", lambda d: {"price": np.ones(2)}),
    }
}


def detection(make: Callable[[], Solution], audit: Callable[[Solution], Any]) -> str:
    """What became of a fraud: refused with a name, failed by rows, or passed. No foreign exception leaves."""
    try:
        result = audit(make())
    except ProblemError as error:
        return f"refused: {error.name}" if error.name else f"passed on without a name: {error}"
    return "passed" if result.passed else "failed: " + ", ".join(f.name for f in result.failures)


@every_plan
def test_the_plans_are_sound(kind: str, tmp_path: Path) -> None:
    holds(plan(kind).audit())
    plan(kind).save(tmp_path / "plan.npz")
    holds(Solution.load(tmp_path / "plan.npz").audit(plan(kind).problem))


def test_the_panel_is_large() -> None:
    assert len(PLANS) * len(FRAUDS) + sum(map(len, FOR_ONE.values())) >= 250


@every_plan
def test_every_fraud_fails_or_is_refused_by_name(kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    genuine = plan(kind)
    passed = []
    for name, edit in {**FRAUDS, **FOR_ONE.get(kind, {})}.items():
        try:
            outcome = detection(partial(edit, genuine), lambda s: s.audit())
        except Exception as error:
            outcome = f"passed on: {type(error).__name__}: {error}"
        if outcome.startswith("passed"):
            passed.append(f"{name}: {outcome}")
    capfd.readouterr()  # the integrator complains of what is not a number
    assert not passed, "\n".join(passed)


@every_plan
@pytest.mark.parametrize("pool", CURVES)
def test_edits_of_the_size_of_rounding_pass(kind: str, pool: str) -> None:
    """The audit does not just say no."""
    for name, change in changes(ROUNDING).items():
        edited = on_values(pool, change)(plan(kind))
        assert edited.audit().passed, f"{name}\n{edited.audit()}"


@every_plan
def test_rounding_of_numbers_passes(kind: str) -> None:
    genuine = plan(kind)
    for edit in (
        field("cost", lambda c: c * (1 + 1e-9)),
        field("t", lambda t: np.append(t[:-1] * (1 + 1e-12), t[-1])),
        field("states", lambda d: {n: v.astype(np.float64) + 0.0 for n, v in d.items()}),
        field("message", lambda words: words + "!"),
        field("iterations", lambda k: k + 1),
        field("name", lambda n: n),
    ):
        holds(edit(genuine).audit())


# ---- files -----------------------------------------------------------------------------------------------------------

FileEdit = Callable[[dict[str, Array]], None]


def head(change: Any) -> FileEdit:
    """An edit of the JSON of a file; what is returned, if anything, takes its place."""

    def edit(arrays: dict[str, Array]) -> None:
        data = json.loads(arrays["head"].tobytes().decode())
        instead = change(data)
        text = json.dumps(data if instead is None else instead)
        arrays["head"] = np.frombuffer(text.encode(), dtype=np.uint8)

    return edit


def put(key: str, value: Any) -> FileEdit:
    def edit(arrays: dict[str, Array]) -> None:
        arrays[key] = value(arrays[key]) if callable(value) else value

    return edit


def drop(key: str) -> FileEdit:
    def edit(arrays: dict[str, Array]) -> None:
        del arrays[key]

    return edit


def file_frauds(genuine: Solution) -> Iterator[tuple[str, FileEdit]]:
    """Every edit of the file of a plan."""
    names = {pool: list(getattr(genuine, pool)) for pool in CURVES}
    keys = ["t", *(f"{pool}/{n}" for pool in CURVES for n in names[pool])]
    keys += [f"{curve}/{segment}" for curve in CURVES.values() for segment in ("breaks", "nodes", "values")]
    for key in [*keys, "head", "variables", "multipliers"]:
        yield f"{key} missing", drop(key)
    for key in keys:
        yield f"{key} nan", put(key, lambda a: a * np.nan)
        yield f"{key} as words", put(key, lambda a: a.astype("U8"))
        yield f"{key} complex", put(key, lambda a: a + 1j)
        yield f"{key} shorter", put(key, lambda a: a[1:])
        yield f"{key} a number", put(key, np.array(1.0))
        yield f"{key} of another dimension", put(key, lambda a: a[None])
    for key in keys:
        if not key.startswith(("t", "costate_interpolant/nodes", "control_interpolant/nodes")):
            yield f"{key} halved and shifted", put(key, lambda a: a / 2 + 0.3 * (np.ptp(a) or 1))
    for name in ("name", "method", "solver", "success", "status", "cost", "iterations", "horizon", "order", "version"):
        yield f"head without {name}", head(lambda h, n=name: h.pop(n) and None)
        yield f"{name} an object", head(lambda h, n=name: h.update({n: {"a": [1, None]}}))
        yield f"{name} a list", head(lambda h, n=name: h.update({n: [1, 2]}))
    of_head: dict[str, list[Any]] = {
        "success": ["no", 1, None, 0.0],
        "cost": ["1", None, True, 1e400],
        "horizon": ["1", None, 0, -1, 1e400],
        "version": ["2", 999, None, -1],
        "iterations": ["many"],
        "name": [None, 5],
        "status": [5],
    }
    for name, values in of_head.items():
        for value in values:
            yield f"{name} {value!r}", head(lambda h, n=name, v=value: h.update({n: v}))
    yield "head not JSON", put("head", np.frombuffer(b"{'a'", dtype=np.uint8))
    yield "head not text", put("head", np.frombuffer(b"\xff\xfe\x00", dtype=np.uint8))
    yield "head a number", head(lambda h: 5)
    yield "head a list", head(lambda h: [1])
    yield "head with a word too many", head(lambda h: h.update({"evil": 1}))
    yield "head deep", put("head", np.frombuffer(b'{"a":' * 5000 + b"1" + b"}" * 5000, dtype=np.uint8))
    for pool, own in names.items():
        yield f"order of {pool} empty", head(lambda h, p=pool: h["order"].update({p: []}))
        yield f"order of {pool} unknown", head(lambda h, p=pool: h["order"].update({p: ["nothing"]}))
        yield f"order of {pool} no list", head(lambda h, p=pool: h["order"].update({p: 5}))
        yield f"order of {pool} missing", head(lambda h, p=pool: h["order"].pop(p) and None)
        yield f"order of {pool} doubled", head(lambda h, p=pool: h["order"].update({p: 2 * h["order"][p]}))
        if len(own) > 1:
            yield f"order of {pool} reversed", head(lambda h, p=pool: h["order"].update({p: h["order"][p][::-1]}))
            first, last = f"{pool}/{own[0]}", f"{pool}/{own[-1]}"

            def swap(arrays: dict[str, Array], first: str = first, last: str = last) -> None:
                arrays[first], arrays[last] = arrays[last], arrays[first]

            yield f"{pool} swapped", swap


def written(file: Path, arrays: dict[str, Array]) -> Path:
    with open(file, "wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
    return file


@every_plan
def test_every_fraud_in_a_file_fails_or_is_refused_by_name(
    kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    genuine = plan(kind)
    genuine.save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz") as archive:
        arrays = dict(archive)
    holds(Solution.load(written(tmp_path / "again.npz", arrays)).audit(genuine.problem))
    passed = []
    for name, edit in file_frauds(genuine):
        edited = dict(arrays)
        edit(edited)
        file = written(tmp_path / "edited.npz", edited)
        try:
            outcome = detection(partial(Solution.load, file), lambda s: s.audit(genuine.problem))
        except Exception as error:
            outcome = f"passed on: {type(error).__name__}: {error}"
        if outcome.startswith("passed"):
            passed.append(f"{name}: {outcome}")
    capfd.readouterr()
    assert not passed, "\n".join(passed)


def test_bytes_that_are_no_plan_are_refused(tmp_path: Path) -> None:
    plan("bounded").save(tmp_path / "plan.npz")
    whole = (tmp_path / "plan.npz").read_bytes()
    rng = np.random.default_rng(5)
    kinds = [b"", b"PK", b"hello", whole[: len(whole) // 2], whole[100:], whole[:-30], bytes(1000)]
    for _ in range(30):  # bytes turned over, as a disk does
        broken = bytearray(whole)
        for place in rng.integers(0, len(whole), size=20):
            broken[place] ^= 1 << int(rng.integers(0, 8))
        kinds.append(bytes(broken))
    stream = io.BytesIO()
    np.save(stream, np.ones(3))
    kinds.append(stream.getvalue())
    for content in kinds:
        file = tmp_path / "broken.npz"
        file.write_bytes(content)
        with pytest.raises(ProblemError):
            Solution.load(file)
