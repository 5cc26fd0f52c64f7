"""Bad input takes little memory: what is too large is refused before anything of it is copied or unpacked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import Robot
from models.checks import check_entries, floats
from models.files import INPUT_LIMITS
from ocp import Solution
from tests.bad_values import WHOLE, Bad, Case, refusal
from tests.models.robot.test_bad_urdf import TEXTS, URDF
from tests.ocp.test_faults import run
from tests.ocp.test_storage import BROKEN, archive, header, npy

SEED, SHARE = 7, 0.2  # of the panels' cases
MOST_MEMORY = 2**30  # bytes
VAST: Bad = {  # of which no memory is taken until they are copied
    "wide view": np.broadcast_to(1.0, (2**15, 2**15)),
    "long view of nan": np.broadcast_to(np.nan, (2**30,)),
    "long range": range(10**12),
    "endless range": range(10**30),
    "list of a long range": [range(10**12)],
}
COUNTLESS: Bad = {"countless": 10**12, "more than a machine word": 10**30}
SEEDED = ("inverse_kinematics", "plan", "plan in segments", "plan through waypoints", "plan to a goal")
TAKEN = {("TipTask", "velocity"), *((name, "seed") for name in SEEDED)}
"""Where something vast may be taken: what is looked at when it is used, and a seed, which may be any whole number."""


def plan_file(path: Path, text: bytes) -> Path:
    """A file whose head is so long a text."""
    return archive(path, {"head.npy": npy(np.frombuffer(text, dtype=np.uint8))})


FILES = BROKEN | {
    "as large as is read": lambda p: archive(p, {"a.npy": header(f"({2**25 - 100},)") + bytes(8 * (2**25 - 100))}),
    "long list in the head": lambda p: plan_file(p, b"[" + b"0," * 2**26 + b"0]"),
    "many lists in the head": lambda p: plan_file(p, b"[" + b"[]," * 2**25 + b"0]"),
    "many lists in a short head": lambda p: plan_file(p, b"[" + b"{}," * (2**24 // 3 - 2) + b"0]"),
}


def ill_treated(folder: Path) -> tuple[int, list[str]]:
    """How much bad input was given, with the plan files of a folder; what is not refused by name, and how it ends."""
    from tests.test_bad_input import CASES

    rng = np.random.default_rng(SEED)
    count, result = 0, []
    for case in CASES:
        for argument, bad in case.bad.items():
            vast = VAST | (COUNTLESS if WHOLE.keys() <= bad.keys() else {})
            request = {label: value for label, value in bad.items() if rng.random() < SHARE} | vast
            may = "is taken" if (case.what, argument) in TAKEN else ""
            matches = [(label, refusal(case, argument, value)) for label, value in request.items()]
            result += [f"{case.what}-{argument}-{label}: {word}" for label, word in matches if word not in ("", may)]
            count += len(request)
    for name, (part, wrong) in TEXTS.items():
        result += [f"{name}: {word}" for word in [refusal(READ, "source", URDF.replace(part, wrong))] if word]
    for path in sorted(folder.iterdir()):
        result += [f"{path.name}: {word}" for word in [refusal(LOAD, "path", path)] if word]
    return count + len(TEXTS) + len(FILES), result


LOAD = Case("Solution.load", Solution.load, {}, {})
READ = Case("from_urdf", Robot.from_urdf, {}, {})


def peak() -> int:
    """Largest resident memory of this process so far, bytes; ru_maxrss would count what its parent had."""
    text = Path("/proc/self/status").read_text(encoding="utf-8")
    return 1024 * int(text.split("VmHWM:")[1].split()[0])


def test_bad_input_and_hostile_files_take_less_than_a_gigabyte(tmp_path: Path) -> None:
    for name, write in FILES.items():
        write(tmp_path / f"{name}.npz")
    code = f"""
        from pathlib import Path
        from tests.test_memory import ill_treated, peak
        count, found = ill_treated(Path({str(tmp_path)!r}))
        print(count, peak())
        print(*found, sep="\\n")
    """
    done = run(code, timeout=240.0)
    assert done.returncode == 0, done.stderr
    numbers, *result = done.stdout.splitlines()
    count, most = map(int, numbers.split())
    assert [line for line in result if line] == []
    assert count > 4000
    assert most < MOST_MEMORY


def test_user_input_is_counted_before_it_is_copied() -> None:
    endless: list[Any] = []
    endless.append(endless)
    for value in VAST.values():
        with pytest.raises((ValueError, OverflowError)):
            check_entries(value)
    for value in (3, "a" * 10**7, None, [], [[]], [1.0, 2.0], np.zeros((3, 0)), range(10**6), endless):
        check_entries(value)
    most = np.broadcast_to(1.0, (INPUT_LIMITS.array_entries,))
    assert floats(most).size == most.size
