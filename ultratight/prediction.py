"""What a run will find, before it: jitter, stress, threshold and margin of every channel.

Loops by `tracking.loop_theory`, filters in their steady state by `tracking.steady_filters`, the
motion that they feel by `predicted_motion`.  Nothing is flown, and no seed is drawn.

The threshold is the C/N0 below which either 3 sigma + stress passes the limit of the discriminator
or noise takes the closure's lock indicator below its own, in a tenth of all runs of that length.
Of closures in which channels share a solution it supposes that all of them fall together.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from signals.constants import C_MPS
from ultratight.filters.catalog import make_filter
from ultratight.predicted_closures import Closure, closure_of
from ultratight.predicted_motion import largest_slope, largest_step, motion, unaided
from ultratight.scenario import InvalidInput, Scenario
from ultratight.world import World

SHIFTS_DB = np.arange(-40.0, 41.0, 2.0)
"""C/N0 of all channels is moved by these; in between the curve is nearly a line in decibels"""
CANNOT_KNOW = (
    "pull-in and re-acquisition; events that overlap: a second one before the first has died out",
    "time near threshold: discriminators bend, loops slip above it or survive below it",
    "which IMU and clock errors a seed draws: those of the data sheet stand for them, at 1 sigma",
    "adaptive, fading and mixing filters: the threshold is that of a linear one",
    "loss that spreads from one channel to others through the filter they share",
    "multipath, interference, atmosphere, faults; rotation of a long lever arm",
)
"""What stands under every table"""


@dataclass(frozen=True)
class Channel:
    """One line of the table; None where a closure has no such number."""

    name: str
    cn0_dbhz: float
    """Lowest of the run"""
    rate_mps: float
    """Largest size along the line of sight; so the next two, between steps"""
    accel_mps2: float
    jerk_mps3: float
    accel_step_mps2: float
    phase_deg: float | None
    """Jitter, 1 sigma at that C/N0: noise and oscillator"""
    doppler_hz: float
    code_m: float
    stress: float
    """Largest error that motion causes, in ``stress_unit``"""
    stress_unit: str
    threshold_dbhz: float
    margin_db: float
    limited_by: str
    """discriminator or indicator"""


@dataclass(frozen=True)
class Prediction:
    """Of a scenario: channels in the order of the run."""

    scenario: str
    closure: str
    channels: tuple[Channel, ...]
    cannot_know: tuple[str, ...] = CANNOT_KNOW

    def to_dict(self) -> dict[str, Any]:
        """Plain data; what is infinite is None."""
        tree = asdict(self)
        for row in tree["channels"]:
            row |= {k: None for k, x in row.items() if isinstance(x, float) and math.isinf(x)}
        return tree


def predict(scenario: Scenario) -> Prediction:
    """Thresholds, jitter and margins of a scenario, in closed form.

    Raises
    ------
    InvalidInput
        What a run would refuse.
    """
    _check_filter(scenario)
    world = World(scenario, 1)
    m = motion(world)
    cn0 = world.cn0_dbhz(np.unique(np.concatenate([m.t_s, _profile_times(scenario)]))).min(axis=0)
    of = closure_of(world, m)
    now = of.errors(cn0)
    rule = _rule(of, cn0)
    threshold = np.maximum(rule, of.indicator_dbhz)
    true = unaided(m)
    chip_m = C_MPS / world.channels.chip_rate_hz
    rows = []
    for i, name in enumerate(world.names):
        rows.append(Channel(
            name, float(cn0[i]), float(np.abs(m.rate[:, i]).max()),
            float(np.abs(true.accel[:, i]).max()), float(largest_slope(m, true.accel)[i]),
            float(largest_step(m, true.accel)[i]),
            None if now.phase_cycles is None else float(360.0 * now.phase_cycles[i]),
            float(now.doppler_hz[i]), float(now.code_chips[i] * chip_m[i]),
            float(now.stress[i] * of.display), of.unit, float(threshold[i]),
            float(cn0[i] - threshold[i]),
            "discriminator" if rule[i] >= of.indicator_dbhz[i] else "indicator",
        ))  # fmt: skip
    return Prediction(scenario.name, scenario.receiver.closure, tuple(rows))


def _check_filter(scenario: Scenario) -> None:
    if scenario.receiver.closure == "ultra-tight":
        try:
            make_filter(scenario.receiver.filter)
        except ValueError as error:
            raise InvalidInput(f"receiver.filter: {error}") from error


def _profile_times(s: Scenario) -> np.ndarray:
    """Where C/N0 changes; at the start and just before the end of each disturbance."""
    times = [t for t, _ in s.channel.cn0_profile_s_db]
    times += [d.t0_s for d in s.channel.disturbance]
    return np.array([t for t in times if 0.0 <= t <= s.duration_s])


def _rule(of: Closure, cn0: np.ndarray) -> np.ndarray:
    """C/N0 (n,) at which 3 sigma + stress comes down to the limit; inf: motion alone is too much.

    -inf where it never comes up to it.
    """
    found = (of.errors(cn0 + x) for x in SHIFTS_DB)
    over = np.log([(e.three_sigma + e.stress) / of.limit for e in found])
    out = np.full(cn0.size, -math.inf)
    for i, column in enumerate(over.T):
        above = np.flatnonzero(column > 0.0)
        if above.size and above[-1] + 1 == SHIFTS_DB.size:
            out[i] = math.inf
        elif above.size:
            k = int(above[-1])
            part = column[k] / (column[k] - column[k + 1])
            out[i] = cn0[i] + SHIFTS_DB[k] + part * (SHIFTS_DB[k + 1] - SHIFTS_DB[k])
    return out


# -- words ---------------------------------------------------------------------------------------

_HEAD = (
    "channel      C/N0   rate   accel    step    jerk    phase  Doppler    code    stress      "
    "threshold  margin  limit\n"
    "            dB-Hz    m/s    m/s2    m/s2    m/s3      deg       Hz       m                "
    "    dB-Hz      dB"
)


def lines(found: Prediction) -> list[str]:
    """A table, and what it cannot know."""
    out = [f"{found.scenario}, closure {found.closure}: before a run, in closed form", _HEAD]
    for c in found.channels:
        phase = "-" if c.phase_deg is None else f"{c.phase_deg:.2f}"
        out.append(
            f"{c.name:11} {c.cn0_dbhz:5.1f} {c.rate_mps:6.0f} {c.accel_mps2:7.2f} "
            f"{c.accel_step_mps2:7.2f} {c.jerk_mps3:7.2f} {phase:>8} {c.doppler_hz:8.3f} "
            f"{c.code_m:7.3f} {c.stress:9.2f} {c.stress_unit:4} {_decibels(c.threshold_dbhz):>8} "
            f"{_decibels(c.margin_db):>7}  {c.limited_by}"
        )
    least = min(found.channels, key=lambda c: (c.margin_db, -c.stress))
    if least.margin_db < 0.0:
        below = sum(c.margin_db < 0.0 for c in found.channels)
        out.append(f"{below} of {len(found.channels)} channels will be lost; worst: {least.name}")
    else:
        out.append(f"least margin: {least.name}, {least.margin_db:.1f} dB")
    out.append("jitter 1 sigma, stress the largest error that motion causes; not known here:")
    return out + [f"  {line}" for line in found.cannot_know]


def _decibels(x: float) -> str:
    return ("none" if x > 0.0 else "-") if math.isinf(x) else f"{x:.1f}"
