"""What the receiver knows at its start: stated, not smuggled in.

A `Knows` and the two streams (samples or taps, IMU increments) are all that a closure ever gets.
It can be written to a file and read back, so that a receiver can be flown from files alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ultratight.ins.error_state import ProcessNoise
from ultratight.tracking.channels import Channels


@dataclass(frozen=True)
class Knows:
    """Ephemerides, a first state with its sigmas, data sheets, and data bits where given."""

    start_week: int
    start_tow_s: float
    prn: np.ndarray  # (n_channel,) int64
    elements: np.ndarray  # (n_channel, N_ELEMENT) broadcast elements, see signals.satellites
    channels: Channels  # the signals' public facts
    cn0_dbhz: np.ndarray  # (n_channel,) first guess
    r_eb_e: np.ndarray  # (3,) IMU position [m]
    v_eb_e: np.ndarray  # (3,) [m/s]
    C_b_e: np.ndarray  # (3, 3)
    clock_m: float
    clock_rate_mps: float
    first_alpha: np.ndarray  # (3,) the IMU increment that ended at the start [rad]
    first_nu: np.ndarray  # (3,) [m/s]
    sigma: np.ndarray  # (17,) of the first error state, in its order and units
    lever_arm_b_m: np.ndarray  # (3,)
    noise: np.ndarray  # densities from the data sheets, in the order of ProcessNoise
    data_bits: np.ndarray | None = None  # (n_channel, n_bit) int8 of +-1
    first_bit: int = 0  # number of the bit in column 0
    scale_factor_sigma: float = 3e-3  # of each accelerometer axis, for a filter with such states

    @property
    def process_noise(self) -> ProcessNoise:
        """Densities of the filter's process noise, from the data sheets."""
        return ProcessNoise(*(float(x) for x in self.noise))

    def initial_covariance(self, n_scale: int = 0) -> np.ndarray:
        """Diagonal covariance of the first error state, with ``n_scale`` scale factors behind."""
        return np.diag(np.append(self.sigma, np.full(n_scale, self.scale_factor_sigma)) ** 2)

    def save(self, path: str | Path) -> None:
        """Write everything to one ``.npz`` file."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "channels"}
        values |= {f"channels.{k}": v for k, v in self.channels._asdict().items()}
        np.savez(path, **{k: v for k, v in values.items() if v is not None})

    @classmethod
    def load(cls, path: str | Path) -> Knows:
        """Read what `save` wrote.  Raises OSError or ValueError for anything else."""
        with np.load(path, allow_pickle=False) as data:
            facts = {f"channels.{k}" for k in Channels._fields}
            names = {f.name for f in fields(cls)} - {"channels"} | facts
            if unknown := set(data.files) - names:
                raise ValueError(f"{path}: unknown entries {sorted(unknown)}")
            values = {k: data[k] if data[k].ndim else data[k].item() for k in data.files}
        if missing := facts - set(values):
            raise ValueError(f"{path}: entries {sorted(missing)} are missing")
        signals = Channels(*(values.pop(f"channels.{k}") for k in Channels._fields))
        return cls(**values, channels=signals)
