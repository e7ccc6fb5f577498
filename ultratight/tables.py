"""What the tables of a scenario have in common, and those of air and sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0.0, le=1e6)]
NotNegative = Annotated[float, Field(ge=0.0, le=1e6)]
Arm = Annotated[float, Field(ge=-1_000.0, le=1_000.0)]
Tau = Annotated[float, Field(ge=0.01, le=1e9)]
Ppm = Annotated[float, Field(ge=-1e5, le=1e5)]
Dbhz = Annotated[float, Field(ge=0.0, le=70.0)]
Change = Annotated[float, Field(ge=-70.0, le=70.0)]
Delay = Annotated[float, Field(ge=-1e5, le=1e5)]
Elevation = Annotated[float, Field(ge=-90.0, le=90.0)]
Azimuth = Annotated[float, Field(ge=-360.0, le=360.0)]
Prn = Annotated[int, Field(ge=1, le=210)]


class Table(BaseModel):
    """A table of keys: frozen, strict, without keys that are not known."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    @model_validator(mode="before")
    @classmethod
    def _lists_are_tuples(cls, data: Any) -> Any:
        return {k: _frozen(v) for k, v in data.items()} if isinstance(data, Mapping) else data


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, list | tuple) else value


class Disturbance(Table):
    """Something that befalls signals from t0_s on and before t1_s; what overlaps adds up.

    The receiver is not told.
    """

    t0_s: NotNegative
    """Times are multiples of 0.005 s"""
    t1_s: Positive | None = None
    """Left out: to the end"""
    prns: tuple[Prn, ...] | None = None
    """Satellites concerned; all by default"""
    elevation_deg: tuple[Elevation, Elevation] | None = None
    """Of these only those between, as seen from the antenna at t0_s: a wall, a roof"""
    azimuth_deg: tuple[Azimuth, Azimuth] | None = None
    """And between these, clockwise from the first to the second: [300.0, 60.0] holds north"""
    cn0_change_db: Change = 0.0
    """Added to C/N0"""
    pseudorange_m: Delay = 0.0
    """Clock fault of the satellite: code, data and carrier arrive so much later"""
    pseudorange_rate_mps: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    """The fault grows by this from t0_s on"""


class Channel(Table):
    """What the path does to the signals."""

    cn0_by_prn_dbhz: dict[
        Annotated[str, Field(pattern=r"^[GE](0[1-9]|[1-9]\d|1\d\d|20\d|210)$")], Dbhz
    ] = {}
    """Satellites that differ from ``cn0_dbhz``: {"G07": 40.0}"""
    cn0_profile_s_db: tuple[tuple[float, Change], ...] = ()
    """(t_s, offset in dB on every satellite), linear between the points, constant outside"""
    disturbance: tuple[Disturbance, ...] = ()
    """Steps of C/N0 and faults of satellites"""


class Atmosphere(Table):
    """What delays the signals on their way; the receiver of a run corrects for none of it."""

    ionosphere: bool = False
    """Klobuchar's model with the coefficients of the constellation (IS-GPS-200 20.3.3.5.2.5)"""
    troposphere: bool = False
    """Saastamoinen's zenith delay in the standard atmosphere, mapped to the elevation"""


class Vector(Table):
    """Closures vdll and vdfll: the solution that steers all channels, from GNSS alone.

    ``receiver.fall_back`` lets a channel that contradicts the others go on by its own loops.
    """

    states: Literal[8, 11] = 11
    """Position, velocity, clock bias and drift; 11: acceleration too"""
    update_s: Annotated[float, Field(ge=0.02, le=0.2)] = 0.02
    """How often the solution is updated and the NCOs are steered: a multiple of a data bit"""
    acceleration_mps2_sqrt_hz: Annotated[float, Field(gt=0.0, le=1e4)] = 3.0
    """8 states: density of the white acceleration, each axis"""
    jerk_mps3_sqrt_hz: Annotated[float, Field(gt=0.0, le=1e5)] = 20.0
    """11 states: density of the white jerk, each axis"""
    acceleration_sigma_mps2: Annotated[float, Field(gt=0.0, le=1e3)] = 10.0
    """11 states: sigma of the first acceleration, which starts at zero"""
    acceleration_tau_s: Annotated[float, Field(ge=0.1, le=1e6)] = 1.0
    """11 states: an acceleration that nobody measures fades with this time constant"""
    search_bits: Annotated[int, Field(ge=0, le=50)] = 2
    """Channels that are lost search around the solution: least data bits in a cell (more, up to 25,
    by the C/N0 that went; a channel that needs yet more waits at the centre); 0: no search"""
    search_false_alarm: Annotated[float, Field(ge=1e-12, le=0.1)] = 1e-4
    """Probability that a cell of the search is believed to hold a signal without one"""


class Federated(Table):
    """Closure federated: a pre-filter per channel between the taps and the central filter.

    ``receiver.measurement`` "differential" needs no data bits.
    """

    update_s: Annotated[float, Field(ge=0.02, le=0.1)] = 0.04
    """From hand-over to hand-over; INS and NCOs are corrected as often"""


class Imu(Table):
    """The inertial sensors; a key that is left out is as the grade has it."""

    grade: str = "industrial-mems"
    """A row of sensor data; the keys below that are left out are as it has them"""
    rate_hz: Annotated[float, Field(ge=10.0, le=10_000.0)] = 200.0
    lever_arm_b_m: tuple[Arm, Arm, Arm] = (0.0, 0.0, 0.0)
    """From the IMU to the antenna, forward-right-down"""
    accel_bias_mg: Annotated[float, Field(ge=0.0, le=1e4)] | None = None
    """Turn-on, 1 sigma"""
    accel_bias_in_run_ug: NotNegative | None = None
    """First-order Gauss-Markov, 1 sigma"""
    accel_bias_tau_s: Tau | None = None
    """Its correlation time"""
    velocity_random_walk_mps_sqrt_s: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """White noise of the accelerometers"""
    accel_scale_factor_ppm: tuple[Ppm, Ppm, Ppm] | None = None
    """A fixed error per axis"""
    accel_scale_factor_alternates: bool = False
    """The fixed error is taken with + for odd seeds and - for even ones"""
    accel_scale_factor_sigma_ppm: Annotated[float, Field(ge=0.0, le=1e5)] | None = None
    """Drawn per axis and run, on top of the fixed error"""
    misalignment_mrad: Annotated[float, Field(ge=0.0, le=100.0)] | None = None
    """Of the accelerometers, 1 sigma"""
    lag_s: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Time constant of a first-order lag of all sensors"""
    saturation_g: Positive | None = None
    """Accelerometers end here; no limit when left out (no grade has one)"""
    gyro_bias_deg_h: Annotated[float, Field(ge=0.0, le=1e5)] | None = None
    """Turn-on, 1 sigma"""
    gyro_bias_in_run_deg_h: Annotated[float, Field(ge=0.0, le=1e5)] | None = None
    """First-order Gauss-Markov, 1 sigma"""
    gyro_bias_tau_s: Tau | None = None
    """Its correlation time"""
    angle_random_walk_rad_sqrt_s: Annotated[float, Field(ge=0.0, le=0.1)] | None = None
    """White noise of the gyros"""
    gyro_scale_factor_ppm: Annotated[float, Field(ge=0.0, le=1e5)] | None = None
    """1 sigma, drawn per axis and run"""
    gyro_g_dependence_deg_h_g: Annotated[float, Field(ge=0.0, le=1e4)] | None = None
    """1 sigma, drawn per axis and run"""
