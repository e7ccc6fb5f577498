"""A bench for tracking loops: the receiver's own scalar closure on taps in closed form.

Every channel has its own C/N0 and its own motion, so that one flight is a whole curve.  No IMU, a
clock without noise: what is measured is what thermal noise and motion do to the loops.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

import ultratight
from signals.code_start import symbol_span
from signals.codes import GPS_L1CA
from signals.constants import C_MPS, CA_CHIP_RATE_HZ, GPS_L1_HZ
from signals.correlator_model import ModelCorrelator
from signals.noise import generator
from signals.propagation import SignalState, signal_state
from ultratight.ins.imu import Increments
from ultratight.tracking.channel_state import new_loops
from ultratight.tracking.channels import channels
from ultratight.tracking.scalar import Scalar, ScalarSettings
from ultratight.world import World

NODE_S, EPOCH_S = 0.005, 0.001
WAVELENGTH_M, CHIP_M = C_MPS / GPS_L1_HZ, C_MPS / CA_CHIP_RATE_HZ
CALM = {"clock.model": "ideal", "clock.bias_m": 0.0, "clock.drift_mps": 0.0}
START_DBHZ, START_S, FALL_S = 50.0, 3.0, 0.5
"""Loops pull in at this C/N0, which then falls to that of the channel; their estimates of power
are set to the new level, which they would take ten seconds to find"""
NO_IMU = Increments(np.zeros(1), np.zeros((0, 3)), np.zeros((0, 3)))


class Flight(NamedTuple):
    """Errors, true - replica, at the nodes t_s (n,) of a flight; (n, n_channel) each."""

    t_s: np.ndarray
    carrier_cycles: np.ndarray  # counts whole cycles from the start on
    hz: np.ndarray  # of the carrier loop's frequency
    chips: np.ndarray
    locked: np.ndarray  # bool
    first_lost_s: np.ndarray  # (n_channel,) NaN where never
    receiver: Scalar

    def held(self, from_s: float) -> np.ndarray:
        """(n_channel,) bool: locked from then on."""
        return np.asarray(self.locked[self.t_s > from_s].all(axis=0))


def falling(cn0_dbhz: np.ndarray, duration_s: float) -> np.ndarray:
    """C/N0 (n_channel, n_node) that begins high and ends at the channels' own (n_channel,)."""
    t = np.arange(round(duration_s / NODE_S) + 1) * NODE_S
    share = np.clip((t - START_S) / FALL_S, 0.0, 1.0)
    start = np.maximum(START_DBHZ, cn0_dbhz)
    return np.asarray(start[:, None] + (cn0_dbhz - start)[:, None] * share)


def pulse(jerk: float, at_s: float, lasts_s: float, duration_s: float) -> np.ndarray:
    """Acceleration (n_node,) that a constant jerk builds up between two times [m/s^2]."""
    t = np.arange(round(duration_s / NODE_S) + 1) * NODE_S
    return np.asarray(jerk * np.clip(t - at_s, 0.0, lasts_s))


def fly(
    settings: ScalarSettings,
    cn0_dbhz: np.ndarray,
    duration_s: float,
    *,
    spacing_chips: float = 0.25,
    acceleration: np.ndarray | float = 0.0,
    seed: int = 1,
) -> Flight:
    """Track from the start on; cn0_dbhz (n_channel, n_node).

    acceleration (..., n_node): of the range, linear between the nodes [m/s^2].
    """
    receiver, correlator, state = _bench(
        settings, cn0_dbhz, duration_s, spacing_chips, acceleration, seed
    )
    per_node, n_row = round(NODE_S / EPOCH_S), round(duration_s / NODE_S) - 1
    n = cn0_dbhz.shape[0]
    carrier, hz, chips = (np.empty((n_row, n)) for _ in range(3))
    locked = np.empty((n_row, n), dtype=np.bool_)
    k, fallen = 0, round((START_S + FALL_S) / NODE_S)
    for row in range(n_row):
        if row == fallen:
            _tell(receiver, cn0_dbhz[:, -1])
        for _ in range(per_node):
            k += 1
            receiver.step(correlator(receiver.steer(k * EPOCH_S, NO_IMU)))
        loops, now = receiver.loops, row + 1
        carrier[row] = state.carrier_phase_cycles[:, now, 0] - loops.carrier_cycles
        hz[row] = state.carrier_phase_cycles[:, now, 1] - loops.loop_hz
        chips[row] = state.code_phase_chips[:, now, 0] - loops.code_chips
        locked[row] = receiver.locked
    return Flight(
        state.t_s[1 : n_row + 1], carrier, hz, chips, locked, receiver.first_lost_s, receiver
    )


def _tell(receiver: Scalar, cn0_dbhz: np.ndarray) -> None:
    """Give the channels the power (n_channel,) that they have now."""
    fresh = new_loops(cn0_dbhz)
    for name in ("narrow", "wide", "moments", "cn0_dbhz"):
        getattr(receiver.loops, name)[:] = getattr(fresh, name)


def _bench(
    settings: ScalarSettings,
    cn0_dbhz: np.ndarray,
    duration_s: float,
    spacing_chips: float,
    acceleration: np.ndarray | float,
    seed: int,
) -> tuple[Scalar, ModelCorrelator, SignalState]:
    world = World(ultratight.load("static", CALM | {"duration_s": duration_s}), seed)
    n = cn0_dbhz.shape[0]
    t = np.arange(round(duration_s / NODE_S) + 1) * NODE_S
    tow_s = world.scenario.start_tow_s
    rows = np.ascontiguousarray(world.elements[np.arange(n) % len(world.prn)])
    first, n_bit = symbol_span(tow_s, t)
    bits = (1 - 2 * generator(seed, "bench").integers(0, 2, (n, n_bit))).astype(np.int8)
    r, v = world.antenna(t)
    still = np.zeros(t.size)
    state = signal_state(rows, tow_s, t, r, v, still, still, cn0_dbhz, bits, first)
    _move(state, np.broadcast_to(acceleration, (n, t.size)))
    prn = 1 + np.arange(n) % 32
    knows = dataclasses.replace(
        world.knows, prn=prn, channels=channels([GPS_L1CA] * n, prn.tolist(), tow_s),
        elements=rows, cn0_dbhz=cn0_dbhz[:, 0].copy(), r_eb_e=r[0], v_eb_e=v[0], clock_m=0.0,
        clock_rate_mps=0.0, data_bits=bits, first_bit=first,
    )  # fmt: skip
    chips = np.stack([GPS_L1CA.chips(int(p)) for p in prn])
    offsets = np.array([-spacing_chips, 0.0, spacing_chips])
    # of one code as of another: each channel has noise of its own by its number
    correlator = ModelCorrelator(state, chips, 1 + np.arange(n), offsets, seed)
    return Scalar(knows, settings, spacing_chips, NODE_S, aided=False), correlator, state


def _move(state: SignalState, acceleration: np.ndarray) -> None:
    """Add the range that an acceleration (n_channel, n_node) makes, exactly, piece by piece."""
    a0, a1 = acceleration[:, :-1], acceleration[:, 1:]
    jerk = (a1 - a0) / NODE_S
    dv = NODE_S * 0.5 * (a0 + a1)
    v = np.cumsum(dv, axis=1) - dv
    dr = NODE_S * (v + NODE_S * (a0 / 2.0 + jerk * NODE_S / 6.0))
    r = np.cumsum(dr, axis=1) - dr
    metres = np.stack([r, v, a0 / 2.0, jerk / 6.0], axis=-1)
    state.carrier_phase_cycles[...] -= metres / WAVELENGTH_M
    state.code_phase_chips[...] -= metres / CHIP_M
