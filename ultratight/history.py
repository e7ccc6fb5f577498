"""What is kept of a run: a row per epoch of what the receiver had, its dumps, and the truth.

Dumps are kept unless the rows have the prompts (``prompt_i``, ``prompt_q``) of whole data bits, as
those of the scalar closures do: their 1 ms dumps would be ten times as much as all the rest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from signals.arcs import arcs
from signals.compiled import borrowing
from signals.constants import C_MPS
from signals.nco import Nco, Taps
from signals.propagation import elevation_azimuth, predict_epochs
from ultratight.consistency import ROW_S
from ultratight.results import EPOCH, Variable
from ultratight.tracking.rows import Rows

if TYPE_CHECKING:
    from ultratight.world import World


ECEF, BODY = np.array(["x", "y", "z"]), np.array(["forward", "right", "down"])
ERRORS = ("r", "v", "psi", "accel_bias", "gyro_bias")
STATE = np.array(
    [f"{name}_{axis}" for name in ERRORS for axis in ECEF]
    + ["clock_m", "clock_rate"]
    + [f"accel_scale_factor_{axis}" for axis in ECEF]
)
"""The states of the covariance: 17, or 20 with the scale factors"""
VECTOR_STATE = np.array(
    [f"{name}_{axis}" for name in ("r", "v") for axis in ECEF]
    + ["clock_m", "clock_rate"]
    + [f"a_{axis}" for axis in ECEF]
)
"""The states of the vector closures: 8, or 11 with the acceleration"""
_OF_VECTOR = (VECTOR_STATE, "error of the vector solution, true minus estimate, ECEF")
LABELS = {
    "xyz": (ECEF, "ECEF axis"),
    "row": (ECEF, "ECEF axis"),
    "column": (BODY, "body axis"),
    "axis": (BODY, "body axis"),
    "state": (STATE, "error state, true minus estimate, ECEF; biases in body axes"),
    "state_2": (STATE, "error state, true minus estimate, ECEF; biases in body axes"),
    "vector_state": _OF_VECTOR,
    "vector_state_2": _OF_VECTOR,
}
"""What stands along a dimension"""


FEWEST_DUMPS = 1024
"""There is room for at least so many"""


class Dumps(NamedTuple):
    """What is kept of each integration (n,), and of its taps (n, n_tap)."""

    channel: np.ndarray
    number: np.ndarray
    start: np.ndarray
    end: np.ndarray
    tap_i: np.ndarray
    tap_q: np.ndarray


def _room_for_dumps(n: int, n_tap: int) -> Dumps:
    return Dumps(
        np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n), np.empty(n),
        np.empty((n, n_tap)), np.empty((n, n_tap)),
    )  # fmt: skip


class History:
    """Arrays that are filled row by row while the receiver runs."""

    def __init__(self, closure: Any, n_epoch: int, dumps: bool = True) -> None:
        self.every = max(1, round(ROW_S / closure.epoch_s))
        n = n_epoch // self.every
        self.t_s = (np.arange(n) + 1) * self.every * closure.epoch_s
        self.fields = closure.fields()
        self.rows = Rows(n, self.fields)
        self.keeps_dumps = dumps and "prompt_i" not in self.fields
        self.dumps: Dumps | None = None
        self.n_dump = 0
        self.nco: tuple[np.ndarray, np.ndarray] | None = None
        self.piece_s = 0.0

    def record(self, k: int, closure: Any, nco: Nco, taps: Taps) -> None:
        """Keep epoch k; rows of epochs that are never reached stay NaN."""
        if self.keeps_dumps:
            self._keep(taps)
        if (k + 1) % self.every:
            return
        row = k // self.every
        if self.nco is None:
            shape = (self.t_s.size, nco.valid.size)
            self.nco = np.full(shape, np.nan), np.full(shape, np.nan)
        self.piece_s = nco.t_s[-1] - nco.t_s[-2]
        _keep_last(nco.carrier_freq_hz, nco.code_phase_chips, *self.nco, row)
        closure.write(self.rows, row)

    def _keep(self, taps: Taps) -> None:
        """Keep the dumps, in arrays that are twice as long whenever they are full."""
        n = self.n_dump + taps.channel.size
        if self.dumps is None or n > self.dumps.tap_i.shape[0]:
            more = _room_for_dumps(max(2 * n, FEWEST_DUMPS), taps.iq.shape[1])
            if self.dumps is not None:
                for old, new in zip(self.dumps, more, strict=True):
                    new[: self.n_dump] = old[: self.n_dump]
            self.dumps = more
        _keep_dumps(*taps[:5], *self.dumps, self.n_dump)
        self.n_dump = n

    def variables(self, names: list[str]) -> dict[str, Variable]:
        """Everything kept, with dimensions and units; dumps have their own dimension."""
        out = {
            name: Variable(self.rows[name], (EPOCH, *dims), units, text)
            for name, (_, dims, units, text) in self.fields.items()
        }
        for dim, size in [x for v in out.values() for x in zip(v.dims, v.data.shape, strict=True)]:
            if dim in LABELS:
                out[dim] = Variable(LABELS[dim][0][:size], (dim,), "", LABELS[dim][1])
        out["channel"] = Variable(np.array(names), ("channel",), "", "signal of each channel")
        if self.nco is not None:
            out["nco_carrier_freq"] = Variable(
                self.nco[0], (EPOCH, "channel"), "Hz", "NCO carrier above IF, last piece"
            )
            out["nco_code_phase"] = Variable(
                self.nco[1], (EPOCH, "channel"), "chips", "NCO code phase, start of last piece"
            )
        if self.dumps is not None and self.n_dump:
            channel, number, start, end, tap_i, tap_q = (x[: self.n_dump] for x in self.dumps)
            out["dump_channel"] = Variable(channel, ("dump",), "1", "channel of the dump")
            out["dump_number"] = Variable(number, ("dump",), "1", "code phase at start / length")
            out["dump_start"] = Variable(start, ("dump",), "s", "first sample")
            out["dump_end"] = Variable(end, ("dump",), "s", "first sample after")
            unit = "standard deviations of the noise"
            out["tap_i"] = Variable(tap_i, ("dump", "tap"), unit, "in-phase tap")
            out["tap_q"] = Variable(tap_q, ("dump", "tap"), unit, "quadrature tap")
        return out


def truth_variables(world: World, t_s: np.ndarray) -> dict[str, Variable]:
    """The truth at receiver times t_s, beside the estimates."""
    t_true = world.true_time(t_s)
    motion = world.trajectory.at(t_true)
    clock_m = np.interp(t_s, world.t_s, world.clock.clock_m)
    # the state, not the slope between nodes, which white frequency noise makes rough
    clock_rate = np.interp(t_s, world.t_s, world.clock.drift_mps)
    imu, sensors = world.imu
    accel_bias, gyro_bias = (
        np.stack([np.interp(t_s, imu.t_s, b) for b in sensors[name].T], axis=1)
        for name in ("accel_bias", "gyro_bias")
    )
    vector = EPOCH, "xyz"
    return {
        "tap": Variable(world.offset_chips, ("tap",), "chips", "delay of the replica: E, P, L"),
        "r_eb_e_true": Variable(motion.r_eb_e, vector, "m", "true IMU position, ECEF"),
        "v_eb_e_true": Variable(motion.v_eb_e, vector, "m/s", "true IMU velocity, ECEF"),
        "C_b_e_true": Variable(
            motion.C_b_e, (EPOCH, "row", "column"), "1", "true attitude, body to ECEF"
        ),
        "speed_true": Variable(
            world.trajectory.speed(t_true), (EPOCH,), "m/s", "true speed over the Earth"
        ),
        "accel_bias_true": Variable(
            accel_bias, (EPOCH, "axis"), "m/s2", "true accelerometer bias, body axes"
        ),
        "gyro_bias_true": Variable(
            gyro_bias, (EPOCH, "axis"), "rad/s", "true gyro bias, body axes"
        ),
        "accel_scale_factor_true": Variable(
            sensors["accel_scale_factor"], ("axis",), "1", "true accelerometer scale factor"
        ),
        "clock_m_true": Variable(clock_m, (EPOCH,), "m", "true receiver clock bias"),
        "clock_rate_true": Variable(clock_rate, (EPOCH,), "m/s", "true receiver clock drift"),
    }


def sky_variables(world: World, t_s: np.ndarray) -> dict[str, Variable]:
    """What each satellite truly is to the antenna at receiver times t_s."""
    clock_m = np.interp(t_s, world.t_s, world.clock.clock_m)
    clock_rate = np.interp(t_s, world.t_s, world.clock.drift_mps)
    r, v = world.antenna(t_s)
    n, channel = world.prn.size, (EPOCH, "channel")
    rho, rate, u = np.empty((t_s.size, n)), np.empty((t_s.size, n)), np.empty((t_s.size, n, 3))
    tow = world.scenario.start_tow_s
    sky = arcs(world.elements, tow, tow + (t_s[-1] if t_s.size else 0.0))
    predict_epochs(sky, tow + t_s, r, v, clock_m, clock_rate, rho, rate, u)
    elevation, azimuth = elevation_azimuth(r[:, None, :], u)
    fault = world.effects(t_s)
    rate += fault.delay_rate_mps.T
    return {
        "pseudorange_true": Variable(
            rho + fault.delay_m.T, channel, "m", "true pseudorange, with both clocks and faults"
        ),
        "pseudorange_fault": Variable(
            np.ascontiguousarray(fault.delay_m.T), channel, "m", "what a clock fault adds to it"
        ),
        "doppler_true": Variable(
            -rate * world.channels.carrier_hz / C_MPS,
            channel,
            "Hz",
            "true Doppler of the carrier, with both clocks and faults",
        ),
        "cn0_true": Variable(world.cn0_dbhz(t_s), channel, "dB-Hz", "true C/N0"),
        "elevation": Variable(
            np.degrees(elevation), channel, "deg", "true elevation of the satellite"
        ),
        "azimuth": Variable(
            np.degrees(azimuth), channel, "deg", "true azimuth of the satellite, from north"
        ),
    }


def replica_errors(world: World, history: History) -> tuple[np.ndarray, np.ndarray]:
    """NCO's carrier frequency [Hz] and code phase [chips] less the true ones.

    (n_epoch, n_channel), where the last piece of an epoch began; NaN after the receiver's end.
    """
    if history.nco is None:
        none = np.full((history.t_s.size, world.prn.size), np.nan)
        return none, none
    truth, t = world.signal, history.t_s - history.piece_s
    k = np.clip(np.searchsorted(truth.t_s, t + 1e-9, "right") - 1, 0, truth.t_s.size - 2)
    h = t - truth.t_s[k]
    carrier, code = truth.carrier_phase_cycles[:, k], truth.code_phase_chips[:, k]
    hz = carrier[..., 1] + h * (2.0 * carrier[..., 2] + 3.0 * h * carrier[..., 3])
    chips = code[..., 0] + h * (code[..., 1] + h * (code[..., 2] + h * code[..., 3]))
    return history.nco[0] - hz.T, history.nco[1] - chips.T


# ---- kernels ---------------------------------------------------------------------------------


@borrowing
def _keep_dumps(
    channel: np.ndarray,
    number: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    iq: np.ndarray,
    all_channel: np.ndarray,
    all_number: np.ndarray,
    all_start: np.ndarray,
    all_end: np.ndarray,
    tap_i: np.ndarray,
    tap_q: np.ndarray,
    n: int,
) -> None:
    """Append the dumps to the n that there are."""
    for k in range(channel.size):
        all_channel[n + k], all_number[n + k] = channel[k], number[k]
        all_start[n + k], all_end[n + k] = start[k], end[k]
        for j in range(iq.shape[1]):
            tap_i[n + k, j], tap_q[n + k, j] = iq[k, j].real, iq[k, j].imag


@borrowing
def _keep_last(
    freq: np.ndarray, code: np.ndarray, all_freq: np.ndarray, all_code: np.ndarray, row: int
) -> None:
    """The command's last piece."""
    last = freq.shape[0] - 1
    for i in range(freq.shape[1]):
        all_freq[row, i] = freq[last, i]
        all_code[row, i] = code[last, i]
