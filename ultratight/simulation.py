"""The one main loop: a command goes down, taps come up, the receiver decides, a row is kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from signals.nco import Correlator, Nco, Taps
from ultratight import metrics
from ultratight.consistency import TIGHT
from ultratight.filters.catalog import make_filter
from ultratight.filters.gaussian import Filter
from ultratight.history import History, replica_errors, sky_variables, truth_variables
from ultratight.ins.imu import Increments
from ultratight.provenance import provenance
from ultratight.results import Event, Run
from ultratight.scenario import InvalidInput, Scenario, Unsupported
from ultratight.tracking.federated import Federated
from ultratight.tracking.knows import Knows
from ultratight.tracking.rows import Fields, Rows
from ultratight.tracking.scalar import Scalar, ScalarSettings
from ultratight.tracking.ultra_tight import Settings, UltraTight
from ultratight.tracking.vector import Vector, VectorSettings
from ultratight.world import World

if TYPE_CHECKING:
    from signals.front_end import Recording, SyntheticIf

PROGRESS_S = 0.5
"""Progress is reported this often, in simulated time [s]"""


class Closure(Protocol):
    """Who closes the loop: scalar, INS-aided scalar, vector, ultra-tight or its federated form."""

    events: list[tuple[float, int, str, str]]
    """(t_s, channel or -1, kind, reason)"""
    diverged: bool
    """There is nothing left to steer with: the run ends here"""

    @property
    def epoch_s(self) -> float:
        """Length of its epochs."""
        ...

    @property
    def first_lost_s(self) -> np.ndarray:
        """(n_channel,) first loss of lock, NaN where there was none."""
        ...

    def steer(self, t_end_s: float, imu: Increments) -> Nco:
        """Command the NCOs up to t_end_s; ``imu`` has the increments that end by then."""
        ...

    def step(self, taps: Taps) -> None:
        """Decide what the taps mean."""
        ...

    def fields(self) -> Fields:
        """What it keeps of each epoch: name -> (shape, dimensions, units, long name)."""
        ...

    def write(self, rows: Rows, k: int) -> None:
        """Write row k of each field."""
        ...


def run(
    scenario: Scenario,
    seed: int = 1,
    *,
    progress: Callable[[float], None] | None = None,
    filter: Filter | None = None,
    samples: SyntheticIf | Recording | None = None,
    whole: bool = True,
) -> Run:
    """Fly a scenario.

    Parameters
    ----------
    scenario : Scenario
    seed : int
        Same seed, same bits.
    progress : callable, optional
        Called with the share that is done, 0 to 1.
    filter : Filter, optional
        A user's own filter in place of the scenario's (``step``, ``reset``).
    samples : SyntheticIf or Recording, optional
        IF samples of the same scenario and seed, to be shared by several runs.
    whole : bool
        False: without dumps and where the satellites truly are, for many runs that need neither.

    Raises
    ------
    InvalidInput
        The scenario cannot be flown: unknown filter or grade, too few satellites.
    """
    began = time.perf_counter()
    world = World(scenario, seed, samples)
    closure = new_closure(scenario, world.knows, filter)
    correlator, imu = world.correlator(), world.imu[0]
    flying = time.perf_counter()
    history = fly(closure, correlator, imu, scenario.duration_s, progress, dumps=whole)
    wall, loop = time.perf_counter() - began, time.perf_counter() - flying
    variables = history.variables(world.names) | truth_variables(world, history.t_s)
    run_ = Run(
        scenario=scenario.to_dict(),
        seed=seed,
        t_s=history.t_s,
        variables=variables | (sky_variables(world, history.t_s) if whole else {}),
        events=[
            Event(round(float(t), 9), world.names[c] if c >= 0 else "", kind, why)
            for t, c, kind, why in closure.events
        ],
        provenance=provenance(scenario, seed),
        summary={},
    )
    hz, chips = replica_errors(world, history)
    off, back = metrics.off_signal_s(history.t_s, hz, chips)
    by_truth = {
        "off_carrier_s": metrics.off_carrier_s(history.t_s, hz),
        "off_signal_s": off,
        "on_signal_s": back,
    }
    run_.summary.update(_summary(run_, scenario, world, closure, by_truth, (wall, loop), filter))
    return run_


def fly(
    closure: Closure,
    correlator: Correlator,
    imu: Increments,
    duration_s: float,
    progress: Callable[[float], None] | None = None,
    *,
    dumps: bool = True,
) -> History:
    """The main loop. It sees no world: a receiver, its correlator and its IMU are all there is."""
    epoch_s = closure.epoch_s
    n_epoch = round(duration_s / epoch_s)
    history = History(closure, n_epoch, dumps)
    report = max(1, round(PROGRESS_S / epoch_s))
    bounds = _increments_until(imu, epoch_s, n_epoch)
    for k in range(n_epoch):
        done, upto = bounds[k], bounds[k + 1]
        nco = closure.steer(
            (k + 1) * epoch_s,
            Increments(imu.t_s[done : upto + 1], imu.alpha_ib_b[done:upto], imu.nu_ib_b[done:upto]),
        )
        taps = correlator(nco)
        closure.step(taps)
        if closure.diverged:
            break
        history.record(k, closure, nco, taps)
        if progress is not None and k % report == 0:
            progress((k + 1) / n_epoch)
    if progress is not None:
        progress(1.0)
    return history


def _increments_until(imu: Increments, epoch_s: float, n_epoch: int) -> list[int]:
    """How many increments have ended at the start and at the end of each epoch (n_epoch + 1)."""
    dt = imu.t_s[1] - imu.t_s[0]
    ends = np.rint(imu.t_s[1:] / dt)  # in IMU intervals
    return np.searchsorted(ends, np.arange(n_epoch + 1) * epoch_s / dt + 1e-6, "right").tolist()


def new_closure(scenario: Scenario, knows: Knows, filter: Filter | None = None) -> Closure:
    """The receiver of a scenario, with nothing but what it knows."""
    r = scenario.receiver
    spacing, piece_s = scenario.correlator.spacing_chips, 1.0 / scenario.imu.rate_hz
    if r.closure in TIGHT:
        if filter is None:
            try:
                filter = make_filter(r.filter)
            except ValueError as error:
                raise InvalidInput(f"receiver.filter: {error}") from error
        settings = Settings(
            measurement="differential" if r.measurement == "differential" else "coherent",
            half_bits=r.measurement == "half-bits" or getattr(filter, "half_bits", False),
            hand_over_s=r.hand_over_s,
            fall_back=r.fall_back,
            epoch_s=r.federated.update_s if r.closure == "federated" else r.epoch_s,
            states=getattr(filter, "states", 17) if r.states is None else r.states,
        )
        if r.closure == "federated":
            return Federated(knows, settings, filter, spacing, piece_s)
        return UltraTight(knows, settings, filter, spacing, piece_s)
    if filter is not None:
        raise Unsupported(f"receiver.closure: {r.closure!r} has no filter to replace")
    scalar = ScalarSettings(**{name: getattr(r, name) for name in ScalarSettings._fields})
    if r.closure in ("vdll", "vdfll"):
        vector = VectorSettings(
            carrier=r.closure == "vdfll", fall_back=r.fall_back, **r.vector.model_dump()
        )
        return Vector(knows, vector, scalar, spacing)
    return Scalar(knows, scalar, spacing, piece_s, aided=r.closure == "scalar-ins")


def jump_window(scenario: Scenario) -> tuple[float, float] | None:
    """From the first to the last instant of acceleration; the scenario may say otherwise."""
    if scenario.jump_window_s is not None:
        return scenario.jump_window_s
    if not scenario.profile:
        return None
    return scenario.profile[0].t0_s, scenario.profile[-1].t1_s


def _summary(
    run_: Run,
    scenario: Scenario,
    world: World,
    closure: Closure,
    by_truth: dict[str, np.ndarray],
    took: tuple[float, float],
    own: Filter | None,
) -> dict[str, Any]:
    r, (wall, loop) = scenario.receiver, took
    tight = r.closure in TIGHT
    name = (type(own).__name__ if own is not None else r.filter) if tight else None
    times = {
        key: {
            name: round(float(t), 6) if np.isfinite(t) else None
            for name, t in zip(world.names, of_channel, strict=True)
        }
        for key, of_channel in {"lost_lock_s": closure.first_lost_s, **by_truth}.items()
    }
    return {
        "scenario": scenario.name,
        "filter": name,
        "closure": r.closure,
        "measurement": r.measurement if tight else None,
        "correlator": scenario.correlator.kind,
        "seed": run_.seed,
        "duration_s": scenario.duration_s,
        "n_satellites": len({name.partition(":")[0] for name in world.names}),
        **times,
        "fall_backs": sum(e.kind == "fall-back" for e in run_.events),
        **metrics.summarise(run_, jump_window(scenario)),
        "wall_s": round(wall, 3),
        "loop_s": round(loop, 3),
        "realtime_factor": round(scenario.duration_s / wall, 2),
        "cpu_path": run_.provenance["cpu_path"],
    }
