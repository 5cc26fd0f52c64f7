"""All reference problems."""

from __future__ import annotations

from . import (
    bolza_free_time,
    brachistochrone,
    bryson_denham,
    catalyst_mixing,
    consumption,
    energy,
    energy_bounded,
    fuller,
    goddard,
    minimum_time,
    pendulum,
    quadratic_regulator,
    rayleigh,
    soft_lander,
    van_der_pol,
)
from .case import Case

CASES: tuple[Case, ...] = (
    energy.CASE,
    energy_bounded.CASE,
    consumption.CASE,
    minimum_time.CASE,
    bryson_denham.CASE,
    bryson_denham.CASE_AS_PATH,
    brachistochrone.CASE,
    rayleigh.CASE,
    rayleigh.CASE_BOUNDED,
    van_der_pol.CASE,
    *quadratic_regulator.CASES,
    soft_lander.CASE,
    bolza_free_time.CASE,
    goddard.CASE,
    catalyst_mixing.CASE,
    fuller.CASE,
    pendulum.CASE,
    pendulum.CASE_IN_ANGLE,
)
