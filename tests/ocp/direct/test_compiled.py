"""Compiled functions equal the interpreted ones to the last bit; libraries are built once and survive failures."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import files as cache
from ocp import Collocation, MultipleShooting, Problem, SolveError, prepare
from ocp.console import TimeLimitReached, time_limited
from ocp.direct import code_generation
from ocp.direct.assembly import Derivatives, derivatives
from ocp.direct.code_generation import CompilerError, build_library, library_key
from ocp.problem.formulation import Formulation
from tests.conformance import brachistochrone, bryson_denham
from tests.conformance.case import Case
from tests.families import some
from tests.ocp.problems import SWING, plant, swing, van_der_pol

ROOT = Path(__file__).parents[3]


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and notices that have not been given yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    code_generation.warn_interpreted.cache_clear()
    return tmp_path / "cache" / "selfmotion"


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache for tests that only query what is compiled."""
    place = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(place))
        yield place / "selfmotion"


def number(value: int) -> tuple[list[str], Callable[[], str]]:
    """Contents and C code of a library with a function that returns a number."""
    return [f"number {value}"], lambda: f"int number(void) {{ return {value}; }}"


def call_count(library: Path) -> int:
    return int(ctypes.CDLL(str(library)).number())


def script(file: Path, lines: str) -> str:
    """A compiler of our own: it says its version, and does some lines."""
    file.write_text(f'#!/bin/sh\nif [ "$1" = --version ]; then echo ours 1; exit; fi\n{lines}\n', encoding="utf-8")
    file.chmod(0o755)
    return str(file)


def is_compiled(prepared: Any) -> bool:
    return any(each.class_name() == "External" for each in prepared.program.gradient.find_functions())


# ---- the same numbers --------------------------------------------------------------------------------------------


def table_problem() -> Problem:
    """Dynamics of MX symbols, with a table in them."""
    x = np.linspace(-3.0, 3.0, 13)
    hill = ca.interpolant("hill", "bspline", [x], 1 + x**2 / 2)
    problem, state, u = plant("over a hill", symbols=ca.MX, initial=0.0, terminal=1.5, u={"guess": 1.0})
    problem.dynamics(state, u / hill(state))
    problem.minimize(running=u**2 / 2)
    return problem


CASES = {
    "SX, parameters, points": (swing, Collocation(4, 2), SWING),
    "SX, four steps": (swing, MultipleShooting(4, steps=4), SWING),
    "MX": (table_problem, Collocation(4, 2, "legendre"), None),
}


@pytest.mark.parametrize("case", CASES)
def test_compiled_functions_are_the_interpreted_ones_to_the_last_bit(shared: Path, case: str) -> None:
    problem, method, _ = CASES[case]
    form = Formulation.of(problem())
    random = np.random.default_rng(0)
    seen = 0
    blocks = method.transcribe(form).blocks
    for block, own in zip(blocks, code_generation.block_derivatives(method.transcribe(form), True), strict=True):
        for name, plain, other in zip(Derivatives._fields, derivatives(block.function), own, strict=True):
            seen += other.class_name() == "External"
            for _ in range(5):
                options = [ca.DM(random.uniform(0.1, 2.0, plain.size_in(i))) for i in range(plain.n_in())]
                for one, two in zip(plain.call(options), other.call(options), strict=True):
                    assert one.sparsity() == two.sparsity(), name
                    np.testing.assert_array_equal(one.nonzeros(), two.nonzeros(), name)
    assert seen


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_compiled_and_interpreted_solves_are_one(shared: Path, case: str, solver: str) -> None:
    problem, method, parameters = CASES[case]
    one, two = (prepare(problem(), method, solver=solver, compiled=how) for how in (True, False))
    assert (is_compiled(one), is_compiled(two)) == (True, False)
    plans = [each.solve(parameters) for each in (one, two)]
    for field in ("variables", "multipliers"):
        np.testing.assert_array_equal(getattr(plans[0], field), getattr(plans[1], field))
    for name, slope in plans[0].cost_gradients.items():
        np.testing.assert_array_equal(slope, plans[1].cost_gradients[name])


@pytest.mark.parametrize("case", [brachistochrone.CASE, bryson_denham.CASE_AS_PATH], ids=lambda case: case.name)
def test_known_optima_are_met_compiled(shared: Path, case: Case) -> None:
    """The whole suite of them passes compiled, too; here for two that take little time."""
    run = case.runs[0]
    prepared = prepare(case.build(), run.method, compiled=True)
    assert is_compiled(prepared)
    below, above = run.cost
    assert -below <= prepared.solve().cost - case.cost <= above


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_conflicting_constraints_are_named_in_the_same_words(shared: Path, solver: str) -> None:
    results = []
    for how in (True, False):
        problem, x, u = plant("too far", initial=0.0, terminal=3.0, u={"lower": -1.0, "upper": 1.0})
        problem.dynamics(x, u * ca.cos(x / 10) ** 2 + ca.sin(x) ** 2 / 100)
        problem.path("fence", x * ca.sin(u), upper=0.5)
        problem.minimize(running=u**2)
        prepared = prepare(problem, Collocation(5), solver=solver, compiled=how)
        assert is_compiled(prepared) == how
        with pytest.raises(SolveError) as error:
            prepared.solve()
        results.append(str(error.value))
    assert results[0] == results[1]
    assert "would have to go" in results[0]


def test_no_optimization_changes_no_number(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_generation, "CODE_SIZES", code_generation.CodeSizes(optimized=0))
    plans = [prepare(van_der_pol(), Collocation(6), compiled=how).solve() for how in (True, False)]
    np.testing.assert_array_equal(plans[0].variables, plans[1].variables)


def test_functions_without_c_code_are_interpreted(own: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An integrator of variable step has none; a function of Python's has no text either."""
    method = MultipleShooting(3, "cvodes")
    prepared = prepare(van_der_pol(), method, compiled=True)
    assert not is_compiled(prepared)
    assert len(caplog.messages) == 1
    np.testing.assert_array_equal(
        prepared.solve().variables, prepare(van_der_pol(), method, compiled=False).solve().variables
    )


# ---- made once ---------------------------------------------------------------------------------------------------


ALONE = """
import ctypes, sys, threading, time, types
for face in ("models", "ocp"):  # what the faces show is not needed, and takes a second
    sys.modules[face] = types.ModuleType(face)
    sys.modules[face].__path__ = [face]
from ocp.direct.code_generation import build_library
def number(value):
    return [f"number {value}"], lambda: f"int number(void) {{ return {value}; }}"
"""
COUNTED = 'echo once >> "$(dirname "$0")/count"; exec cc "$@"'


def test_meshes_share_compiled_functions(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", script(tmp_path / "counted", COUNTED))
    for method in (Collocation(3), Collocation(9), Collocation(2, mesh=(0.0, 0.1, 1.0))):
        prepared = prepare(van_der_pol(), method, compiled=True)
        assert is_compiled(prepared)
        assert prepared.solve().success
    assert not is_compiled(prepare(van_der_pol(), Collocation(5)))  # kept or not
    assert (tmp_path / "count").read_text().split() == ["once"]


def test_processes_compile_once(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", script(tmp_path / "slow", f"sleep 0.5; {COUNTED}"))
    words = ALONE + "print(ctypes.CDLL(str(build_library(*number(3)))).number())"
    both = [subprocess.Popen([sys.executable, "-c", words], cwd=ROOT, stdout=subprocess.PIPE) for _ in range(2)]
    assert [process.communicate()[0] for process in both] == [b"3\n", b"3\n"]
    assert (tmp_path / "count").read_text().split() == ["once"]
    assert [file.suffix for file in own.iterdir()] == [".so"]


def test_compilers_and_contents_are_distinguished(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = number(1)[0], number(2)[0]
    keys = [library_key(contents) for contents in (one, two)]
    monkeypatch.setenv("CC", script(tmp_path / "another", COUNTED))
    keys.append(library_key(one))
    newer = (tmp_path / "another").read_text().replace("ours 1", "ours 2")
    (tmp_path / "another").write_text(newer)
    assert library_key(one) == keys[-1]  # asked once a process for its version
    code_generation._version.cache_clear()
    keys.append(library_key(one))
    assert len(set(keys)) == len(keys) == 4


# ---- what goes wrong ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", [b"", b"\x7fELF", None])
def test_a_damaged_file_is_written_anew(own: Path, damage: bytes | None) -> None:
    library = build_library(*number(4))
    whole = library.read_bytes()
    library.unlink()  # Python has not loaded it
    library.write_bytes(whole[:-1] + b"x" if damage is None else damage)
    assert cache.load_library(library_key(number(4)[0])) is None
    assert call_count(build_library(*number(4))) == 4
    assert [file.read_bytes() for file in own.iterdir()] == [whole]


def test_without_a_folder_it_is_compiled_for_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("CC", script(tmp_path / "counted", COUNTED))
    hows = (True, True, False)
    plans = [prepare(van_der_pol(), Collocation(3), compiled=how) for how in hows]
    assert [is_compiled(plan) for plan in plans] == [True, True, False]
    assert (tmp_path / "count").read_text().split() == ["once"]


def test_a_folder_that_may_only_be_read_serves(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = build_library(*number(5))

    def refused(*_: Any, **__: Any) -> Any:
        raise PermissionError

    monkeypatch.setattr(os, "utime", refused)
    monkeypatch.setattr(cache, "NamedTemporaryFile", refused)
    assert build_library(*number(5)) == library
    assert call_count(build_library(*number(6))) == 6
    assert build_library(*number(6)) != library


@pytest.mark.parametrize("words", ["false", "no-such-compiler", "'", " "])
def test_without_a_compiler_the_numbers_are_the_same_and_one_line_says_so(
    own: Path, words: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CC", words)
    plans = [prepare(van_der_pol(), Collocation(4), compiled=how).solve() for how in (True, True, False)]
    for plan in plans[:-1]:
        np.testing.assert_array_equal(plan.variables, plans[-1].variables)
    (record,) = (record for record in caplog.records if record.levelno >= logging.WARNING)
    assert "no C compiler" in record.getMessage()
    assert not own.exists()


@pytest.mark.parametrize("compiler", ["cc", "false"])
def test_the_solver_and_its_numbers_depend_on_no_cache_and_no_compiler(
    own: Path, compiler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before, during and after a compiled solve; nothing else is compiled."""
    monkeypatch.setenv("CC", compiler)
    plans = []
    problem, method = van_der_pol(), Collocation(6)
    for make in (prepare, partial(prepare, compiled=True), prepare):
        prepared = make(problem, method)
        assert is_compiled(prepared) == (make is not prepare and compiler == "cc")
        plans.append(prepared.solve())
        if len(plans) == 1:
            assert not own.exists()
        assert plans[-1].solver == "ipopt"
        assert plans[-1].iterations == plans[0].iterations
        np.testing.assert_array_equal(plans[-1].variables, plans[0].variables)


def test_a_failing_compiler_is_reported_and_not_tried_again(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CC", script(tmp_path / "failing", "echo no room on device >&2; exit 1"))
    with pytest.raises(CompilerError, match="no room on device"):
        build_library(*number(7))
    assert prepare(van_der_pol(), Collocation(4), compiled=True).solve().success
    assert "no room on device" in caplog.text


def test_undefined_functions_are_no_library() -> None:
    """A call of it would be the end of Python."""
    with pytest.raises(CompilerError, match="fails"):
        build_library(["undefined"], lambda: "int gone(void); int number(void) { return gone(); }")


def test_long_functions_are_not_compiled(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_generation, "CODE_SIZES", code_generation.CodeSizes(accepted=10))
    with pytest.raises(CompilerError, match="characters"):
        build_library(*number(8))


def test_a_library_of_somebody_else_is_not_run(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    key = library_key(number(9)[0])
    assert cache.load_library(key) is None
    library = build_library(*number(9))
    assert cache.load_library(key) == library
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    if library.stat().st_uid == 0:
        os.chown(library, 12345, -1)
    assert cache.load_library(key) is None


def test_libraries_that_are_used_least_make_room(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [build_library(*number(value)) for value in range(10, 13)]
    for age, file in enumerate(files):
        os.utime(file, (0, 1000 + age))
    assert build_library(*number(10)) == files[0]  # used again
    monkeypatch.setattr(cache, "MAX_LIBRARY_BYTES", 3 * files[0].stat().st_size)
    newest = build_library(*number(13))
    assert {file for file in own.iterdir() if file.suffix == ".so"} == {files[0], files[2], newest}
    monkeypatch.setattr(cache, "MAX_LIBRARY_BYTES", 0)
    assert build_library(*number(14)).exists()  # what is needed now stays
    assert len(list(own.glob("*.so"))) == 1


# ---- locks, and what is stopped --------------------------------------------------------------------------------------


def test_locks_are_removed_unless_somebody_has_them(own: Path) -> None:
    build_library(*number(21))
    (own / "left.lock").touch()
    with cache.exclusive("taken"):
        build_library(*number(22))
        assert {file.name for file in own.glob("*.lock")} == {"taken.lock"}
    assert not list(own.glob("*.lock"))


SLOW = 'echo $$ > "$(dirname "$0")/pid"; sleep 60 & wait'


def test_a_time_limit_ends_the_wait_and_leaves_nothing(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", script(tmp_path / "slow", SLOW))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    with time_limited(0.3), pytest.raises(TimeLimitReached):
        build_library(*number(17))
    assert is_gone(appears(tmp_path / "pid"))
    assert is_empty(tmp_path / "temporary")
    assert not list(own.iterdir())


LEAVING = """
threading.Thread(target=build_library, args=number(18), daemon=True).start()
print("under way", flush=True)
time.sleep(float(sys.argv[1]))
"""


@pytest.mark.parametrize("how", some([None, signal.SIGINT, signal.SIGKILL], 1))
def test_a_process_that_ends_takes_its_compiler_along(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: signal.Signals | None
) -> None:
    monkeypatch.setenv("CC", script(tmp_path / "slow", SLOW))
    (tmp_path / "temporary").mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
    words = [sys.executable, "-c", ALONE + LEAVING, "60" if how else "1"]
    process = subprocess.Popen(words, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    assert process.stdout.readline() == b"under way\n"
    pid = appears(tmp_path / "pid")
    if how is not None:
        process.send_signal(how)
    process.communicate()
    assert is_gone(pid)
    assert is_empty(tmp_path / "temporary")
    assert cache.load_library(library_key(number(18)[0])) is None


PATIENCE = 300.0
"""s, after which a wait is given up."""


def appears(file: Path) -> int:
    """The number in a file, as soon as it is there."""
    deadline = time.monotonic() + PATIENCE
    while not (file.exists() and file.read_text().strip()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return int(file.read_text())


def is_empty(folder: Path) -> bool:
    """Whether a folder is, or becomes, empty."""
    deadline = time.monotonic() + PATIENCE
    while list(folder.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not list(folder.iterdir())


def is_gone(pid: int) -> bool:
    """Whether a process ends."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


# ---- no result depends on a cache or a compiler ------------------------------------------------------------------


def test_a_result_is_the_same_with_an_empty_cache_a_warm_one_and_without_a_compiler(
    own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def contents() -> list[bytes | str | int]:
        one = prepare(van_der_pol(), Collocation(8, 3)).solve()
        other = prepare(van_der_pol((1.0, 0.0), upper=1.0, lower=-1.0), MultipleShooting(8)).solve()
        parts = [(each.variables.tobytes(), each.multipliers.tobytes(), each.solver) for each in (one, other)]
        return [*parts[0], *parts[1], one.iterations, other.iterations]

    empty = contents()
    prepare(van_der_pol(), Collocation(8, 3), compiled=True)
    assert list(own.rglob("*.so")), "the cache is warm now"
    assert contents() == empty
    monkeypatch.setenv("CC", "false")
    assert contents() == empty
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another"))
    assert contents() == empty
