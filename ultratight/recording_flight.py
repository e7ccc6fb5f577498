"""A closure flown on a recording, from where scalar tracking and decoding have come to.

`plan` checks what it is to be, before any work; `fly_recording` begins at an instant at which the
position filter runs, levels the INS, tells the closure what has been found (`take_over`) and flies
it on the samples and the IMU's data to their end.  Nobody is told the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from signals.codes import GPS_L1CA
from signals.constants import OMEGA_EARTH, WEEK_S
from signals.correlator import SampleCorrelator
from signals.recording import Recording
from ultratight.config import InvalidInput
from ultratight.consistency import ROW_S, TIGHT
from ultratight.data_sheets import imu_errors, process_noise
from ultratight.ins.alignment import Alignment, align
from ultratight.ins.attitude import euler_from_rotation, rotation_from_euler
from ultratight.ins.earth import geodetic_from_ecef, rotation_e_from_n
from ultratight.ins.imu import Increments
from ultratight.ins.imu_table import read_increments
from ultratight.provenance import provenance
from ultratight.results import Event, Run
from ultratight.scenario import Scenario
from ultratight.simulation import Closure, fly, new_closure
from ultratight.tables import Federated
from ultratight.tracking.channel_state import LOCKED
from ultratight.tracking.knows import Knows
from ultratight.tracking.lock import LOST_BELOW
from ultratight.tracking.navigation import Navigation, Position
from ultratight.tracking.take_over import Inertial, Later, estimates, knows_at

INERTIAL = (*TIGHT, "scalar-ins")
CLOSURES = (*INERTIAL, "vdfll", "vdll", "scalar")
WINDOW_S = 2.0
"""So long the position filter runs before a closure takes over, and velocities level the INS"""
LARGEST_SIGMA = math.radians(10.0)
"""Of the attitude, with which a closure is begun: its filter is linear in it"""
_EPOCHS = {
    "ultra-tight": ("receiver.epoch_s", ROW_S),
    "federated": ("receiver.federated.update_s", Federated().update_s),
}
"""Closures that close with the INS: key and usual length of an epoch"""
_KEYS = ("receiver.", "imu.", "clock.model", "correlator.spacing_chips")
_NOT = ("receiver.knows.", "imu.rate_hz", "receiver.closure")


class Attitude(NamedTuple):
    """What is stated of the attitude at the start."""

    roll_pitch_heading_deg: tuple[float, float, float]
    sigma_deg: float = 1.0


class Plan(NamedTuple):
    """What is to be flown, checked; the scenario's start is filled in when it is known."""

    scenario: Scenario
    imu: Increments | None
    attitude: Attitude | None = None
    take_over_s: float | None = None


class Flown(NamedTuple):
    """A flight; times of the run are receiver time since sample 0."""

    run: Run
    knows: Knows
    t0_s: float
    """Where the closure took over"""
    attitude_deg: tuple[float, float, float] | None
    """Roll, pitch and heading that it was told"""


def plan(
    closure: str,
    end_s: float,
    *,
    filter_name: str | None = None,
    imu: Path | None = None,
    grade: str | None = None,
    attitude: Attitude | None = None,
    take_over_s: float | None = None,
    changes: Sequence[str] = (),
) -> Plan:
    """A closure on a recording of which samples up to ``end_s`` are tracked.

    ``changes`` (key=value) are those of a scenario's receiver, IMU and clock.

    Raises
    ------
    InvalidInput, ValueError
        What cannot be flown, by name.
    """
    if closure not in CLOSURES:
        raise InvalidInput(f"--closure: {closure} given, expected one of {', '.join(CLOSURES)}")
    if filter_name is not None and closure not in TIGHT:
        raise InvalidInput(f"--filter: {filter_name} given, expected none with {closure}")
    _check_keys(changes)
    needed = closure in INERTIAL
    if needed != (imu is not None):
        said = "nothing given, expected the IMU's data" if needed else f"{imu} given, expected none"
        raise InvalidInput(f"--imu: {said} with {closure}")
    pairs = [change.partition("=") for change in changes]
    given = {key.strip(): value for key, _, value in pairs}
    if needed and grade is None and "imu.grade" not in given:
        raise InvalidInput(
            "--imu-grade: nothing given, expected the data sheet of the IMU: a grade of "
            "`ultratight scenarios --keys`"
        )
    table = None if imu is None else read_increments(imu)
    if table is not None and table.t_s[-1] < end_s - 1e-6:
        raise InvalidInput(
            f"{imu}: ends at t_s = {table.t_s[-1]:.3f}, expected {end_s:.3f} s, the end of the "
            "samples (--duration shortens them)"
        )
    if take_over_s is not None and not 0.0 <= take_over_s < end_s:
        raise InvalidInput(
            f"--take-over: {take_over_s:g} given, expected 0 to {end_s:g} s, the end of the samples"
        )
    _check_attitude(attitude)
    tree = _receiver(closure, filter_name, grade, table, given)
    scenario = Scenario.from_dict(tree).replace(changes)
    return Plan(scenario, table, attitude, take_over_s)


def _check_keys(changes: Sequence[str]) -> None:
    for change in changes:
        key = change.partition("=")[0].strip()
        if not key.startswith(_KEYS) or key.startswith(_NOT):
            raise InvalidInput(
                f"--set: {key} given, expected a key of receiver or imu, clock.model or "
                "correlator.spacing_chips; all else is as the recording has it"
            )


def _check_attitude(attitude: Attitude | None) -> None:
    if attitude is None:
        return
    angles, limits = attitude.roll_pitch_heading_deg, (180.0, 90.0, 360.0)
    if not all(abs(a) <= most for a, most in zip(angles, limits, strict=True)):
        raise InvalidInput(
            f"--attitude: {','.join(f'{a:g}' for a in angles)} given, expected roll within 180, "
            "pitch within 90, heading within 360 deg"
        )
    if not 0.0 < math.radians(attitude.sigma_deg) <= LARGEST_SIGMA:
        raise InvalidInput(
            f"--attitude-sigma-deg: {attitude.sigma_deg:g} given, expected more than 0, at most "
            f"{math.degrees(LARGEST_SIGMA):g}"
        )


def _receiver(
    closure: str,
    filter_name: str | None,
    grade: str | None,
    imu: Increments | None,
    given: Mapping[str, str],
) -> dict[str, Any]:
    """The part of a scenario that a receiver is; nobody knows the data bits of a recording.

    ``given`` will be laid over it; a second or so that it can last is filled in.
    """
    receiver: dict[str, Any] = {
        "closure": closure,
        "measurement": "differential",
        "aiding_clock": "learnt",
        "knows": {"data_bits": False},
    }
    sensors: dict[str, Any] = {} if grade is None else {"grade": grade}
    if filter_name is not None:
        receiver["filter"] = filter_name
    step = ROW_S
    if imu is not None:
        dt = _interval(imu)
        sensors["rate_hz"] = 1.0 / dt
        if closure in _EPOCHS:
            key, usual = _EPOCHS[closure]
            with suppress(KeyError, ValueError):  # what is no number is refused with its key
                usual = float(given[key])
            step = max(1, round(usual / dt)) * dt  # whole IMU intervals
            receiver |= (
                {"federated": {"update_s": step}} if closure == "federated" else {"epoch_s": step}
            )
    return {"name": "recording", "duration_s": 50.0 * step, "receiver": receiver, "imu": sensors}


def _epoch_s(s: Scenario) -> float:
    r = s.receiver
    if r.closure == "federated":
        return r.federated.update_s
    return r.epoch_s if r.closure == "ultra-tight" else ROW_S


def _interval(imu: Increments) -> float:
    return float(imu.t_s[-1] - imu.t_s[0]) / (imu.t_s.size - 1)


def fly_recording(
    of: Plan,
    recording: Recording,
    nav: Navigation,
    end_sample: int,
    *,
    atmosphere: bool,
    progress: Callable[[float], None] | None = None,
) -> Flown:
    """Fly the plan's closure on the samples up to ``end_sample``.

    ``atmosphere``: the signals came through one, its delays are corrected as at the start.

    Raises
    ------
    ValueError
        There is no position to begin with, or no attitude, or nothing left to fly.
    """
    position, window = _position(of, nav)
    t0_s, first = _start(of, position)
    end_s = end_sample / recording.sample_rate_hz
    scenario = _with_start(of, nav.week, position, end_s - t0_s)
    errors = imu_errors(scenario, 1)
    inertial = _inertial(of, window, first, scenario) if of.imu is not None else None
    knows = knows_at(
        nav, position, t0_s, scenario.duration_s, process_noise(scenario, errors),
        inertial=inertial, atmosphere=atmosphere,
    )  # fmt: skip
    closure = new_closure(scenario, knows)
    chips = np.array([GPS_L1CA.chips(int(p)) for p in knows.prn], np.int8)
    spacing = scenario.correlator.spacing_chips * np.array([-1.0, 0.0, 1.0])
    correlator = Later(SampleCorrelator(recording, chips, spacing), t0_s)
    imu = _increments(of.imu, first, scenario.duration_s)
    history = fly(closure, correlator, imu, scenario.duration_s, progress)
    names = [f"G{p:02d}:L1CA" for p in knows.prn.tolist()]
    run = Run(
        scenario=scenario.to_dict(),
        seed=0,
        t_s=t0_s + history.t_s,
        variables=history.variables(names),
        events=[
            Event(round(float(t0_s + t), 9), names[c] if c >= 0 else "", kind, why)
            for t, c, kind, why in closure.events
        ],
        provenance=provenance(scenario, 0),
        summary=_summary(scenario, closure, names, t0_s, history.t_s),
    )
    told = None
    if inertial is not None:
        told = _euler_deg(knows.r_eb_e, inertial.C_b_e)
    return Flown(run, knows, t0_s, told)


def _summary(
    scenario: Scenario, closure: Closure, names: list[str], t0_s: float, t_s: np.ndarray
) -> dict[str, Any]:
    r = scenario.receiver
    tight = r.closure in TIGHT
    lost = [round(t0_s + t, 6) if math.isfinite(t) else None for t in closure.first_lost_s.tolist()]
    return {
        "closure": r.closure,
        "filter": r.filter if tight else None,
        "measurement": r.measurement if tight else None,
        "end_s": t0_s + float(t_s[-1]),
        "diverged": closure.diverged,
        "lost_lock_s": dict(zip(names, lost, strict=True)),
    }


def locked(run: Run) -> np.ndarray:
    """Which channels the closure takes for locked (n_row, n_channel)."""
    if "contributes" in run:
        return np.asarray(run["contributes"] > 0.5)
    if "tracking_phase" in run:
        return np.asarray(run["tracking_phase"] == LOCKED)
    return np.asarray(run["lock_indicator"] > LOST_BELOW)


def _position(of: Plan, nav: Navigation) -> tuple[Position, list[Position]]:
    """Where the closure takes over, and the epochs of the window before, that one included."""
    found = [p for p, _ in estimates(nav)]
    if not found:
        raise ValueError(f"no position for the closure to begin with: {nav.why_not}")
    earliest = found[0].t_s + WINDOW_S
    from_s = earliest if of.take_over_s is None else of.take_over_s
    if from_s < earliest - 1e-6:
        raise ValueError(
            f"--take-over: {from_s:g} given, expected {earliest:.3f} or more: the first position "
            f"comes at {found[0].t_s:.3f} s"
        )
    at = next((p for p in found if p.t_s >= from_s - 1e-6), None)
    if at is None:
        raise ValueError(
            f"no position at {from_s:.3f} s or later for the closure to begin with: the last one "
            f"is at {found[-1].t_s:.3f} s"
        )
    return at, [p for p in found if at.t_s - WINDOW_S - 1e-6 <= p.t_s <= at.t_s]


def _start(of: Plan, position: Position) -> tuple[float, int]:
    """When the closure takes over: the IMU's first node from the position on, and its number."""
    if of.imu is None:
        return position.t_s, 0
    first = int(np.searchsorted(of.imu.t_s, position.t_s - 1e-9))
    if first == 0 or first >= of.imu.t_s.size - 1:
        raise ValueError(
            f"IMU data from {of.imu.t_s[0]:.3f} to {of.imu.t_s[-1]:.3f} s: expected "
            f"{position.t_s - WINDOW_S:.3f} s, from which on is levelled, to the end of the samples"
        )
    return float(of.imu.t_s[first]), first


def _with_start(of: Plan, week: int, position: Position, left_s: float) -> Scenario:
    """The plan's scenario with start and length of this flight."""
    s, estimate = of.scenario, position.estimate
    assert estimate is not None
    step = _epoch_s(s)
    n = math.floor(left_s / step + 1e-9)
    if n * step < 1.0:
        raise ValueError(
            f"{left_s:.2f} s are left for the closure from {position.t_s:.3f} s on, expected 1 s"
        )
    lat, lon, h = (float(x) for x in geodetic_from_ecef(estimate.state[:3]))
    north, east, _ = rotation_e_from_n(lat, lon).T @ estimate.state[4:7]
    return s.replace(
        {
            "duration_s": n * step,
            "start_week": week + math.floor(position.tow_s / WEEK_S),
            "start_tow_s": position.tow_s % WEEK_S,
            "position_lla_deg_m": [math.degrees(lat), math.degrees(lon), h],
            "heading_deg": math.degrees(math.atan2(east, north)),
            "speed_mps": math.hypot(north, east),
        }
    )


def _increments(imu: Increments | None, first: int, duration_s: float) -> Increments:
    """The IMU's data from node ``first`` on, in time since then; none, where there is no IMU."""
    if imu is None:
        return Increments(np.array([0.0, duration_s]), np.zeros((1, 3)), np.zeros((1, 3)))
    n = imu.t_s.size - first
    return Increments(_interval(imu) * np.arange(n), imu.alpha_ib_b[first:], imu.nu_ib_b[first:])


def _inertial(of: Plan, window: list[Position], first: int, scenario: Scenario) -> Inertial:
    """Attitude at node ``first``, and what the data sheet says."""
    assert of.imu is not None
    imu, errors, at = of.imu, imu_errors(scenario, 1), window[-1]
    estimate = at.estimate
    assert estimate is not None
    r, dt = estimate.state[:3], _interval(of.imu)
    accel = math.hypot(errors.accel_bias_turn_on, errors.accel_bias_in_run)
    gyro = math.hypot(errors.gyro_bias_turn_on, errors.gyro_bias_in_run)
    if of.attitude is not None:
        roll, pitch, heading = np.radians(of.attitude.roll_pitch_heading_deg)
        lat, lon, _ = geodetic_from_ecef(r)
        C = rotation_e_from_n(lat, lon) @ rotation_from_euler(roll, pitch, heading)
        found = Alignment(C, np.full(3, math.radians(of.attitude.sigma_deg)))
    else:
        states = [p.estimate.state for p in window if p.estimate is not None]
        sigma = math.sqrt(float(np.trace(estimate.cov[4:7, 4:7])) / 3.0)
        times, velocities = np.array([p.t_s for p in window]), np.array([x[4:7] for x in states])
        found = align(imu, times, r, velocities, sigma, accel)
        _check_levelled(found, r)
    omega = imu.alpha_ib_b[first - 1] / dt - found.C_b_e.T @ [0.0, 0.0, OMEGA_EARTH]
    return Inertial(
        found.C_b_e, found.sigma, accel, gyro, imu.alpha_ib_b[first - 1], imu.nu_ib_b[first - 1],
        np.array(scenario.imu.lever_arm_b_m), omega,
    )  # fmt: skip


def _check_levelled(found: Alignment, r: np.ndarray) -> None:
    worst = float(found.sigma.max())
    if not worst <= LARGEST_SIGMA:
        raise ValueError(
            f"the course tells the attitude to {math.degrees(worst):.1f} deg only, expected "
            f"{math.degrees(LARGEST_SIGMA):g}: too slow, or force and course too near each other; "
            "--attitude states it"
        )
    roll = _euler_deg(r, found.C_b_e)[0]
    if abs(roll) > 90.0:
        raise ValueError(
            f"the IMU's data mean a roll of {roll:.0f} deg, upside down: expected axes "
            "forward-right-down, -9.8 m/s2 on z at rest; --attitude states it if it is so"
        )


def _euler_deg(r: np.ndarray, C_b_e: np.ndarray) -> tuple[float, float, float]:
    lat, lon, _ = geodetic_from_ecef(r)
    angles = np.degrees(euler_from_rotation(rotation_e_from_n(lat, lon).T @ C_b_e))
    return float(angles[0]), float(angles[1]), float(angles[2]) % 360.0
