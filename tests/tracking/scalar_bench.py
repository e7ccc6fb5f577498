"""A bench for the scalar loops: channels in uniform motion in closed form, and theory's jitter."""

import dataclasses

import numpy as np

from signals import clock
from signals.code_start import symbol_span
from signals.codes import GPS_L1CA
from signals.correlator_model import ModelCorrelator
from signals.noise import generator
from signals.propagation import SignalState, signal_state
from ultratight import scenario
from ultratight.ins.imu import Increments
from ultratight.tracking.channel_state import CHIP_M
from ultratight.tracking.channels import channels
from ultratight.tracking.scalar import Scalar, ScalarSettings
from ultratight.world import World

NO_IMU = Increments(np.zeros(1), np.zeros((0, 3)), np.zeros((0, 3)))
NODE_S = 0.005
CALM = [
    'clock.model="ideal"',
    "clock.bias_m=0.0",
    "clock.drift_mps=0.0",
]
LOOP = ["receiver.integration_s=0.005", "receiver.bandwidth_hz=18.0"]
FAST = ScalarSettings(0.005, 18.0)


@dataclasses.dataclass
class Bench:
    """Channels in uniform motion, each with its own code, bits and oscillator; no IMU."""

    receiver: Scalar
    correlator: ModelCorrelator
    state: SignalState

    def step(self, k: int) -> None:
        """Millisecond k."""
        s = self.receiver
        s.step(self.correlator(s.steer((k + 1) * 0.001, NO_IMU)))

    def run(self, until_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the NCO (n_epoch, n_channel): carrier [cycles], less half cycles; code."""
        s, steps = self.receiver, []
        for k in range(round(s.t_s * 1000.0), round(until_s * 1000.0)):
            self.step(k)
            steps.append((s.t_s, s.loops.carrier_cycles.copy(), s.loops.code_chips.copy()))
        t, carrier, code = (np.array(a) for a in zip(*steps, strict=True))
        error = true_phase(self.state.t_s, self.state.carrier_phase_cycles, t) - carrier
        code_error = true_phase(self.state.t_s, self.state.code_phase_chips, t) - code
        return (error + 0.25) % 0.5 - 0.25, code_error


def true_phase(nodes, cubic, t):
    p = np.minimum((t / NODE_S + 1e-6).astype(int), nodes.size - 2)
    dt = t - nodes[p]
    c = cubic[:, p]
    return (((c[..., 3] * dt + c[..., 2]) * dt + c[..., 1]) * dt + c[..., 0]).T


def bench(
    settings, n, duration_s, level_dbhz, *,
    spacing=0.25, oscillator="ideal", seed=1, divergence_mps=0.0, **told,
) -> Bench:  # fmt: skip
    """n channels, PRN 1 ... n, on the lines of sight of the preset `uniform`.

    level_dbhz: C/N0, (n_node,) or a number.  told: changes to the receiver's perfect knowledge.
    divergence_mps: the code's range grows so much faster than the carrier's.
    """
    world = World(scenario.load("uniform", CALM), seed)
    t = np.arange(round(duration_s / NODE_S) + 1) * NODE_S
    r, v = world.antenna(t)
    prn = np.arange(1, n + 1)
    rows = world.elements[np.arange(n) % len(world.prn)]
    first, n_bit = symbol_span(world.scenario.start_tow_s, t)
    rng = generator(seed, "bench")
    bits = (1 - 2 * rng.integers(0, 2, (n, n_bit))).astype(np.int8)
    cn0 = np.broadcast_to(level_dbhz, (1, t.size))
    parts = []
    for i in range(n):
        ticks = clock.simulate(clock.OSCILLATORS[oscillator], t, rng)
        parts.append(
            signal_state(
                rows[i : i + 1], world.scenario.start_tow_s, t, r, v,
                ticks.clock_m, ticks.clock_rate_mps, cn0, bits[i : i + 1], first,
            )
        )  # fmt: skip
    joined = ("code_phase_chips", "carrier_phase_cycles", "cn0_dbhz", "valid", "symbols")
    state = parts[0]._replace(
        **{k: np.concatenate([getattr(part, k) for part in parts]) for k in joined}
    )
    state.code_phase_chips[:, :, 0] -= divergence_mps / CHIP_M * t[: state.t_s.size - 1]
    state.code_phase_chips[:, :, 1] -= divergence_mps / CHIP_M
    perfect = {
        "prn": prn, "channels": channels([GPS_L1CA] * len(prn), prn, world.scenario.start_tow_s),
        "elements": rows, "cn0_dbhz": state.cn0_dbhz[:, 0], "r_eb_e": r[0],
        "v_eb_e": v[0], "clock_m": 0.0, "clock_rate_mps": 0.0,
        "data_bits": bits, "first_bit": first,
    }  # fmt: skip
    knows = dataclasses.replace(world.knows, **(perfect | told))
    chips = np.stack([GPS_L1CA.chips(int(p)) for p in prn])
    offsets = np.array([-spacing, 0.0, spacing])
    return Bench(
        Scalar(knows, settings, spacing, NODE_S, aided=False),
        ModelCorrelator(state, chips, prn, offsets, seed),
        state,
    )


def loss_reasons(receiver):
    return [reason for _, _, kind, reason in receiver.events if kind == "loss of lock"]


def thermal_cycles(bn_hz, t_s, cn0_dbhz):
    """Costas loop with squaring loss, Kaplan & Hegarty, 3rd ed., ch. 8."""
    c = 10.0 ** (cn0_dbhz / 10.0)
    return np.sqrt(bn_hz / c * (1.0 + 1.0 / (2.0 * t_s * c))) / (2.0 * np.pi)


def delay_jitter_chips(prn, bn_hz, t_s, cn0_dbhz, spacing):
    """Dot product, D = 2 spacing, with the slope 1 - R(1) of the code's own peak."""
    c = 10.0 ** (cn0_dbhz / 10.0)
    slope = np.array([1.0 - GPS_L1CA.autocorrelation(int(p))[1] for p in prn])
    return np.sqrt(bn_hz * spacing / (slope * c) * (1.0 + 1.0 / (t_s * c)))
