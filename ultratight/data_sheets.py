"""From a scenario's data-sheet figures to sensor errors, and to the filter's process noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from signals.clock import OSCILLATORS, Oscillator
from signals.constants import STANDARD_GRAVITY
from ultratight.ins.error_state import ProcessNoise
from ultratight.ins.imu import GRADES, ImuErrors, deg_per_h, deg_per_h_per_g, mg, ppm, ug
from ultratight.scenario import InvalidInput, Scenario


def imu_errors(scenario: Scenario, seed: int) -> ImuErrors:
    """The named grade with the scenario's changes.

    A fixed scale factor that alternates is positive for odd seeds, negative for even ones.
    """
    imu = scenario.imu
    if imu.grade not in GRADES:
        raise InvalidInput(
            f"imu.grade: {imu.grade!r} given, expected one of {', '.join(sorted(GRADES))}"
        )
    sign = -1.0 if imu.accel_scale_factor_alternates and seed % 2 == 0 else 1.0
    in_si: dict[str, tuple[float | None, Callable[[float], float]]] = {
        "accel_bias_turn_on": (imu.accel_bias_mg, mg),
        "accel_bias_in_run": (imu.accel_bias_in_run_ug, ug),
        "accel_bias_tau_s": (imu.accel_bias_tau_s, float),
        "vrw": (imu.velocity_random_walk_mps_sqrt_s, float),
        "accel_scale_factor_sigma": (imu.accel_scale_factor_sigma_ppm, ppm),
        "accel_misalignment": (imu.misalignment_mrad, lambda x: 1e-3 * x),
        "lag_s": (imu.lag_s, float),
        "saturation_mps2": (imu.saturation_g, lambda x: x * STANDARD_GRAVITY),
        "gyro_bias_turn_on": (imu.gyro_bias_deg_h, deg_per_h),
        "gyro_bias_in_run": (imu.gyro_bias_in_run_deg_h, deg_per_h),
        "gyro_bias_tau_s": (imu.gyro_bias_tau_s, float),
        "arw": (imu.angle_random_walk_rad_sqrt_s, float),
        "gyro_scale_factor_sigma": (imu.gyro_scale_factor_ppm, ppm),
        "gyro_g_dependence": (imu.gyro_g_dependence_deg_h_g, deg_per_h_per_g),
    }
    changes: dict[str, Any] = {
        name: convert(x) for name, (x, convert) in in_si.items() if x is not None
    }
    if imu.accel_scale_factor_ppm is not None:
        changes["accel_scale_factor"] = tuple(sign * ppm(x) for x in imu.accel_scale_factor_ppm)
    return replace(GRADES[imu.grade], **changes)


def oscillator(key: str, name: str) -> Oscillator:
    """The named oscillator; `InvalidInput` speaks of ``key``."""
    if name not in OSCILLATORS:
        known = ", ".join(sorted(OSCILLATORS))
        raise InvalidInput(f"{key}: {name!r} given, expected one of {known}")
    return OSCILLATORS[name]


def process_noise(scenario: Scenario, errors: ImuErrors) -> ProcessNoise:
    """What the filter believes: the true data sheets, unless the scenario tells it otherwise.

    Biases are random walks with q = 2 sigma^2 / tau.
    """
    told = scenario.receiver.process_noise

    def either(value: float | None, ours: float) -> float:
        return ours if value is None else value

    vrw = either(told.velocity_random_walk_mps_sqrt_s, errors.vrw)
    arw = either(told.angle_random_walk_rad_sqrt_s, errors.arw)
    accel = errors.accel_bias_in_run
    gyro = errors.gyro_bias_in_run
    if told.accel_bias_in_run_ug is not None:
        accel = ug(told.accel_bias_in_run_ug)
    if told.gyro_bias_in_run_deg_h is not None:
        gyro = deg_per_h(told.gyro_bias_in_run_deg_h)
    name = told.clock_model or scenario.clock.model
    clock = oscillator("receiver.process_noise.clock_model", name)
    return ProcessNoise(
        velocity=vrw**2,
        attitude=arw**2,
        accel_bias=2.0 * accel**2 / errors.accel_bias_tau_s,
        gyro_bias=2.0 * gyro**2 / errors.gyro_bias_tau_s,
        clock_sf=clock.bias_psd,
        clock_sg=clock.drift_psd,
        scale_factor=ppm(told.accel_scale_factor_ppm_sqrt_s) ** 2,
    )
