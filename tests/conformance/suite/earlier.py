"""Problems of the suites that were stated before, with their closed forms, in `tests.conformance` and `tests.ocp`."""

from __future__ import annotations

from ocp import Collocation, Indirect
from tests.conformance import bryson_denham, catalyst_mixing, goddard, van_der_pol
from tests.ocp.problem import flights

from .entry import COPS, PSOPT, TOOLBOX, Entry

ENTRIES = (
    Entry(
        "bryson_denham", (PSOPT, TOOLBOX), bryson_denham.build, {PSOPT: 3.999539}, bryson_denham.CASE.cost,
        Collocation(40, 3),
    ),
    Entry(
        "catmix", (PSOPT, COPS), catalyst_mixing.build, {PSOPT: -0.0480532, COPS: -4.8056e-2},
        catalyst_mixing.CASE.cost,
    ),
    Entry("rocket", (COPS, TOOLBOX), goddard.build, {COPS: -1.0128}, goddard.CASE.cost),
    Entry(
        "vanderpol", (TOOLBOX,), van_der_pol.build, {"CTDirect": 1.047921}, van_der_pol.CASE.cost, Collocation(20, 4),
        Indirect(),
    ),
    Entry(
        "twoburn", (PSOPT,), flights.two_burns, {PSOPT: -0.2367249}, method=Collocation(20, 4),
        second=Collocation(30, 3, "legendre"),
    ),
    Entry(
        "launch", (PSOPT,), flights.launch, {PSOPT: f"{-7529.661 / flights.MASS:.7g}"}, method=Collocation(15, 4),
        second=Collocation(22, 3, "legendre"), note="mass in units of that at the start",
    ),
)  # fmt: skip
