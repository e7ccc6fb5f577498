"""JTQ in the closed loop: acceptance tests of its specification, and a control that must fail."""

from dataclasses import replace

import numpy as np
import pytest

import ultratight
from ultratight.filters.catalog import make_filter
from ultratight.filters.jump_triggered import JTQ, JTQ_R

CAUSE_OFF = {
    "imu.grade": "matched", "imu.lag_s": 0.0, "imu.accel_scale_factor_ppm": [0.0, 0.0, 0.0],
}  # fmt: skip
SHORT = {
    "duration_s": 11.0,
    "profile": [{"t0_s": 6.0, "t1_s": 9.0, "accel0_mps2": 100.0, "accel1_mps2": 100.0}],
}
TCXO = {"clock.g_sensitivity_ppb_per_g": 1.0}


def flown(filter, seed=700, iterations=None, several=JTQ, **changes):
    scenario = ultratight.load("jump-1", CAUSE_OFF | SHORT | {"receiver.filter": filter} | changes)
    own = make_filter(filter, iterations=iterations, several=several) if iterations else None
    return ultratight.run(scenario, seed, filter=own)


def speed_error(run):
    return np.linalg.norm(run["v_eb_e_true"] - run["v_eb_e"], axis=1)


def jump_rms(run):
    return run.summary["velocity_rms_mps"]["jump"]


def kinds(run):
    return [event.kind for event in run.events]


@pytest.mark.parametrize("name", ["jtq", "jtq-r"])
def test_before_the_first_step_it_is_the_quadrature_filter(name):
    """Acceptance 1: to 1e-3 m/s, and no false alarm of the score test."""
    mine, plain = flown(name), flown("qkf", **{"receiver.measurement": "coherent"})
    before = (mine.t_s > 5.0) & (mine.t_s <= 6.0)
    close = np.linalg.norm(mine["v_eb_e"] - plain["v_eb_e"], axis=1)[before]
    same_form = name == "jtq"
    assert close.max() < (1e-3 if same_form else 6e-3)  # half bits: other noise, same accuracy
    assert kinds(mine).count("opened") == 2
    assert "reopened" not in kinds(mine)


@pytest.mark.parametrize("name", ["jtq", "jtq-e", "jtq-r"])
@pytest.mark.parametrize(
    "cause",
    [{"imu.accel_scale_factor_ppm": [10_000.0, 0.0, 0.0]}, {"imu.saturation_g": 10.0}, TCXO],
    ids=["scale factor", "saturation", "oscillator"],
)
def test_no_cause_breaks_the_lock(name, cause):
    """Specification, section 3, over 20 s: at most 0.025 m/s; here over 3 s, that is sqrt(6.7) x.

    The plain filter has 1 to 11 m/s.
    """
    run = flown(name, **cause)
    assert run.summary["converged"]
    assert jump_rms(run) < 0.025 * np.sqrt(20.0 / 3.0)
    assert all(t is None for t in run.summary["lost_lock_s"].values())
    assert kinds(run).count("opened") == 2


def test_one_pass_loses_what_four_keep():
    """Acceptance 4, the control: the same prior, 3 points and one pass, loses lock to a TCXO.

    Measured over seeds 700-707: 0.3 to 28 m/s against 0.02 to 0.08 m/s.
    """
    back = {"t0_s": 8.0, "t1_s": 10.0, "accel0_mps2": -100.0, "accel1_mps2": -100.0}
    there = SHORT["profile"][0] | {"t1_s": 8.0}
    world = TCXO | {"profile": [there, back], "duration_s": 12.0}
    once = replace(JTQ, wide=False)
    lost = [jump_rms(flown("jtq", s, several=once, iterations=1, **world)) for s in (700, 702)]
    kept = [jump_rms(flown("jtq", s, **world)) for s in (700, 702)]
    assert max(kept) < 0.1
    assert min(lost) > 50.0 * max(kept)


def test_a_clock_jump_costs_the_velocity_little():
    """Section 4: the bound is that of no jump at all; found within 20 % after the first 0.2 s."""
    ideal, clock = flown("jtq"), flown("jtq", **TCXO)
    settled = (ideal.t_s > 6.2) & (ideal.t_s <= 9.0)
    quiet = np.sqrt(np.mean(speed_error(ideal)[settled] ** 2))
    assert np.sqrt(np.mean(speed_error(clock)[settled] ** 2)) < 1.2 * quiet


def test_half_bits_by_the_scenario_and_by_the_filter_are_the_same():
    asked = flown("jtq-e")
    told = flown("jtq", **{"receiver.measurement": "half-bits"})
    np.testing.assert_array_equal(asked["v_eb_e"], told["v_eb_e"])
    n = len(asked.summary["lost_lock_s"])
    assert asked["n_measurement"][-50:].max() == 5 * n
    apart = flown("jtq", **{"receiver.measurement": "differential"})
    assert not apart["coherent"].any()
    assert apart["n_measurement"].max() == 3 * n


@pytest.mark.parametrize("late_s", [0.0, 0.01])
def test_a_poor_oscillator_keeps_the_lock(late_s):
    """3 ppb/g: 9 m/s, then 18 m/s of drift, which turn half a bit through 3 and 6 rad.

    Measured over 20 s of jump on seeds 700-707: 0.009 to 0.15 m/s, here over 3 s.  The control
    without the exact mean of the prompts does not converge.
    """
    there = SHORT["profile"][0] | {"t0_s": 6.0 + late_s, "t1_s": 8.0 + late_s}
    back = {"t0_s": 8.0 + late_s, "t1_s": 9.0, "accel0_mps2": -100.0, "accel1_mps2": -100.0}
    world = {"clock.g_sensitivity_ppb_per_g": 3.0, "profile": [there, back]}
    run = flown("jtq-r", 704, **world)
    assert run.summary["converged"]
    assert jump_rms(run) < 0.15 * np.sqrt(20.0 / 3.0)
    plain = replace(JTQ_R, exact=False)
    assert not flown("jtq-r", 704, iterations=4, several=plain, **world).summary["converged"]


def test_power_that_returns_is_not_taken_for_motion():
    """A fade of 10 dB in the jump: no worse than the plain filter, which reopens nothing; with the
    score test left on the estimate ended metres per second off."""
    fade = {"channel.disturbance": [{"t0_s": 7.0, "t1_s": 10.0, "cn0_change_db": -10.0}]}
    longer = {"duration_s": 14.0, "profile": [SHORT["profile"][0] | {"t1_s": 12.0}]}
    cause = {"imu.accel_scale_factor_ppm": [3000.0, 0.0, 0.0]}
    changes = fade | longer | cause | {"receiver.measurement": "differential"}
    for seed in (700, 701):
        mine, plain = (flown(name, seed, **changes) for name in ("jtq-r", "qkf"))
        assert jump_rms(mine) < jump_rms(plain)
        assert mine.summary["converged"]
