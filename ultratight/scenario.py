"""Scenario: a validated, frozen description of a world, its receiver and how long they run.

Units stand in the names of the keys (`config` says what is wrong with a file).  A scenario holds
no seed: the same scenario is run with many.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, model_validator

from ultratight import config, consistency, named_files
from ultratight.config import InvalidInput, Unsupported
from ultratight.consistency import SPEED_LIMIT_MPS, VIBRATION_LIMIT_HZ, Label
from ultratight.loop_keys import LoopKeys
from ultratight.tables import (
    Atmosphere,
    Channel,
    Dbhz,
    Federated,
    Imu,
    NotNegative,
    Positive,
    Prn,
    Table,
    Vector,
)

__all__ = [
    "PRESETS",
    "InvalidInput",
    "Scenario",
    "Unsupported",
    "load",
    "preset_text",
    "preset_tree",
]

Acceleration = Annotated[float, Field(ge=-10_000.0, le=10_000.0)]
TurnRate = Annotated[float, Field(ge=-360.0, le=360.0)]

PRESETS = (
    "jump-1", "jump-2", "jump-3", "jump-4", "uniform", "accelerated", "static", "rocket-launch",
    "urban-outage",
)  # fmt: skip
"""Scenarios that ship, as ``ultratight/presets/NAME.toml``"""
_KEYS_ONLY = "keys only"
"""Validation context: leave out the rules between keys"""


class Segment(Table):
    """A stretch of the speed profile: acceleration along the velocity and turn rate, both linear.

    Outside all segments both are zero.
    """

    t0_s: NotNegative
    t1_s: Positive
    accel0_mps2: Acceleration = 0.0
    """Along the velocity, at t0_s"""
    accel1_mps2: Acceleration = 0.0
    """At t1_s"""
    turn_rate0_deg_s: TurnRate = 0.0
    """Of the heading, clockwise, in a vertical plane of the climb angle, upwards; at t0_s"""
    turn_rate1_deg_s: TurnRate = 0.0
    """At t1_s"""


class Vibration(Table):
    """A stretch of random vibration with a flat spectrum, the same in every run."""

    t0_s: NotNegative
    """It rises and falls within 0.25 s"""
    t1_s: Positive
    rms_g: Annotated[float, Field(gt=0.0, le=100.0)]
    """Acceleration along each of three axes"""
    from_hz: Annotated[float, Field(ge=1.0, le=VIBRATION_LIMIT_HZ)] = 5.0
    to_hz: Annotated[float, Field(ge=1.0, le=VIBRATION_LIMIT_HZ)] = VIBRATION_LIMIT_HZ
    """Four nodes of the truth in a cycle; above, the carrier moves by micrometres"""


class Clock(Table):
    """The receiver's oscillator."""

    model: str = "tcxo"
    bias_m: Annotated[float, Field(ge=-3e6, le=3e6)] = 300.0
    """At the start: c times the time that the receiver is ahead"""
    drift_mps: Annotated[float, Field(ge=-30_000.0, le=30_000.0)] = 30.0
    """At the start: c times the relative frequency error"""
    g_sensitivity_ppb_per_g: Annotated[float, Field(ge=-100.0, le=100.0)] = 0.0
    """Along the forward axis"""


class FrontEnd(Table):
    """How IF samples are taken: complex, signal at ``if_hz``."""

    sample_rate_hz: Annotated[float, Field(gt=0.0, le=200e6)] = 4.0e6
    if_hz: float = 0.0
    sample_format: Literal["int8", "float32"] = "int8"


class Correlator(Table):
    """How taps are made: from samples, or in closed form ("model")."""

    kind: Literal["model", "samples"] = "model"
    """model: closed form with the same mean and covariance"""
    spacing_chips: Annotated[float, Field(gt=0.0, le=1.0)] = 0.25
    """Early and late replica: distance from the prompt one; BOC has side peaks at 1/2 chip"""
    multiple_access: bool = False
    """Closed form only: add the noise that the other satellites' codes make"""


class Knows(Table):
    """What the receiver is told before it starts, and how well (1 sigma)."""

    bit_edges: bool = True
    """Only true is built"""
    data_bits: bool = True
    """The coherent measurement needs them"""
    ephemerides: bool = True
    """Only true is built"""
    initial_state: bool = True
    """Only true is built"""
    position_sigma_m: Annotated[float, Field(gt=0.0, le=1e3)] = 5.0
    velocity_sigma_mps: Annotated[float, Field(gt=0.0, le=50.0)] = 0.5
    tilt_sigma_mrad: Annotated[float, Field(gt=0.0, le=200.0)] = 1.5
    heading_sigma_mrad: Annotated[float, Field(gt=0.0, le=200.0)] = 3.0
    clock_sigma_m: Annotated[float, Field(gt=0.0, le=3e3)] = 10.0
    clock_rate_sigma_mps: Annotated[float, Field(gt=0.0, le=50.0)] = 0.5
    cn0_sigma_db: Annotated[float, Field(ge=0.0, le=10.0)] = 1.0
    accel_scale_factor_sigma_ppm: Annotated[float, Field(gt=0.0, le=1e5)] = 3000.0
    """First sigma of the scale-factor states of a 20-state filter, which start at zero"""


class ProcessNoise(Table):
    """What the filter believes of IMU and clock; a key left out is the true data sheet's value."""

    velocity_random_walk_mps_sqrt_s: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    angle_random_walk_rad_sqrt_s: Annotated[float, Field(ge=0.0, le=0.1)] | None = None
    accel_bias_in_run_ug: NotNegative | None = None
    gyro_bias_in_run_deg_h: Annotated[float, Field(ge=0.0, le=1e5)] | None = None
    accel_scale_factor_ppm_sqrt_s: Annotated[float, Field(ge=0.0, le=1e4)] = 0.0
    """Random walk of the scale-factor states; 0: constants, as those of the IMU are"""
    clock_model: str | None = None


class Receiver(LoopKeys):
    """Who closes the loop, with which filter and measurement, and what it knows."""

    closure: Literal["ultra-tight", "federated", "scalar", "scalar-ins", "vdll", "vdfll"] = (
        "ultra-tight"
    )
    """Who closes the loop: INS and filter, these fed by pre-filters, channel loops, vector loops"""
    filter: str = "fiqkf-r"
    """Of both ultra-tight forms: see `ultratight filters`, or FILE.py:NAME, package.module:NAME"""
    states: Literal[17, 20] | None = None
    """20: three accelerometer scale factors more; by default what the filter's row says"""
    measurement: Literal["coherent", "half-bits", "differential"] = "coherent"
    """Carrier phase with known data bits, of whole or half bits, or without (its change)"""
    epoch_s: Annotated[float, Field(ge=0.001, le=0.1)] = 0.02
    """Ultra-tight closure: one filter step and one command; the others have their own"""
    hand_over_s: NotNegative = 2.0
    """A coherent receiver starts with differential measurements and changes over at this time"""
    fall_back: bool = True
    """To differential measurements on loss of lock, and back after ``hand_over_s``"""
    federated: Federated = Federated()
    vector: Vector = Vector()
    knows: Knows = Knows()
    process_noise: ProcessNoise = ProcessNoise()


class Scenario(Table):
    """A world and its receiver.  Every key has one home and one unit; see the classes above."""

    name: Annotated[str, Field(min_length=1)]
    title: str = ""
    """One line: what happens"""
    why: str = ""
    """One line: why it exists"""
    duration_s: Annotated[float, Field(gt=0.0, le=86_400.0)]
    start_week: Annotated[int, Field(ge=0, le=10_000)] = 2149
    """GPS week, without rollover"""
    start_tow_s: Annotated[float, Field(ge=0.0, lt=604_800.0)] = 475_220.0
    position_lla_deg_m: tuple[
        Annotated[float, Field(ge=-90.0, le=90.0)],
        Annotated[float, Field(ge=-180.0, le=180.0)],
        Annotated[float, Field(ge=-1_000.0, le=2_000_000.0)],
    ] = (39.9, 116.4, 8_000.0)
    """Start: geodetic latitude, longitude and height, WGS-84"""
    heading_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 0.0
    speed_mps: Annotated[float, Field(ge=-SPEED_LIMIT_MPS, le=SPEED_LIMIT_MPS)] = 0.0
    mask_deg: Annotated[float, Field(ge=-5.0, lt=90.0)] = 10.0
    """Satellites below at the start are left out"""
    cn0_dbhz: Dbhz = 35.0
    """Of every satellite and signal: the power of that component alone"""
    signals: tuple[Label, ...] = ("L1CA",)
    """Every satellite sends each of them"""
    galileo_codes: Annotated[str, Field(min_length=1)] | None = None
    """File of the E1 memory codes (CSV: prn, signal, 1023 hexadecimal digits), for E1B and E1C"""
    constellation: Annotated[str, Field(min_length=1)] = "embedded"
    """"embedded" (GPS, 2021-03-19), "nominal-24", "galileo-24" or a RINEX navigation file (GPS)"""
    max_satellites: Annotated[int, Field(ge=1, le=210)] | None = None
    """The highest ones are kept"""
    prns: tuple[Prn, ...] | None = None
    """Satellites to keep; all by default"""
    plane: Literal["horizontal", "vertical"] = "horizontal"
    """Of the motion, at the start; turns change the heading in the one, the climb in the other"""
    climb_deg: Annotated[float, Field(ge=-90.0, le=90.0)] = 0.0
    """Vertical plane: first angle of the velocity above the horizontal"""
    profile: tuple[Segment, ...] = ()
    """Stretches of linear acceleration and turn rate; both are zero elsewhere"""
    vibration: tuple[Vibration, ...] = ()
    """Stretches of vibration; what overlaps adds up"""
    jump_window_s: tuple[NotNegative, NotNegative] | None = None
    """What the summary calls the jump; by default from the first to the last segment"""
    trajectory: Annotated[str, Field(min_length=1)] | None = None
    """A file of positions (CSV) in place of start, heading, speed and profile"""
    data_bits: Literal["random", "lnav"] = "random"
    """What the satellites send: random bits, or the navigation message of the constellation"""
    atmosphere: Atmosphere = Atmosphere()
    channel: Channel = Channel()
    imu: Imu = Imu()
    clock: Clock = Clock()
    front_end: FrontEnd = FrontEnd()
    correlator: Correlator = Correlator()
    receiver: Receiver = Receiver()

    @model_validator(mode="after")
    def _consistent(self, info: ValidationInfo) -> Scenario:
        found = (
            [] if info.context == _KEYS_ONLY else [m for _, m in consistency.contradictions(self)]
        )
        if found:
            raise ValueError("; ".join(found))
        return self

    @classmethod
    def from_dict(cls, tree: Mapping[str, Any], source: str = "") -> Scenario:
        """Validate nested plain data.  `InvalidInput` lists every problem at once."""
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            found = _all_problems(tree, error)
        raise InvalidInput([f"{source}: {line}" if source else line for line in found])

    @classmethod
    def from_toml(cls, text: str, source: str = "scenario") -> Scenario:
        """A whole scenario (without ``extends``) from TOML text."""
        return cls.from_dict(config.parse_toml(text, source), source)

    def to_dict(self) -> dict[str, Any]:
        """Nested plain data: dicts, lists, texts, numbers; keys that are None are left out."""
        return self.model_dump(mode="json", exclude_none=True)

    def to_toml(self) -> str:
        """The resolved scenario with every key there is; `from_toml` gives it back.

        Comments say what keys mean; keys that are not set are comments themselves.
        """
        notes = {key.name: key.meaning for key in config.keys(Scenario)}
        return config.write_toml(self.model_dump(mode="json"), notes=notes)

    def digest(self) -> str:
        """SHA-256 of the resolved scenario as canonical JSON.

        Files that it names enter by their content, wherever they are; OSError if one is gone.
        """
        tree = named_files.by_content(self.to_dict())
        text = json.dumps(tree, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def files_sha256(self) -> dict[str, str]:
        """SHA-256 of each file that the scenario names, by its key."""
        return named_files.sha256(self.to_dict())

    def replace(self, changes: Mapping[str, Any] | Iterable[str]) -> Scenario:
        """A validated copy with dotted changes: {"imu.lag_s": 0.01} or ["imu.lag_s=0.01"]."""
        return self.from_dict(_changed(self.to_dict(), config.nest(changes)))

    def warnings(self) -> list[str]:
        """Lines about what is allowed and seldom wanted."""
        found = consistency.commensurate(self.front_end.sample_rate_hz, self.signals)
        if self.atmosphere.ionosphere or self.atmosphere.troposphere:
            found.append(
                "atmosphere: the receiver of a run knows nothing of it and corrects nothing: "
                "metres of bias in its ranges"
            )
        return found


def _all_problems(tree: Mapping[str, Any], error: ValidationError) -> list[str]:
    """Problems of single keys, and of the rules between the keys that are sound in themselves."""
    bad = [[str(p) for p in item["loc"] if isinstance(p, str)] for item in error.errors()]
    bad = [location for location in bad if location]
    found = config.problems(Scenario, error) if bad else []
    sound: dict[str, Any] = dict(tree)
    for location in bad:
        sound = config.without(sound, location)
    if bad:
        sound = {"name": "-", "duration_s": 1.0} | sound
    try:
        partial = Scenario.model_validate(sound, context=_KEYS_ONLY)
    except ValidationError:
        return found
    names = [".".join(location) for location in bad]
    return found + [
        message
        for keys, message in consistency.contradictions(partial)
        if not any(name == key or name.startswith(f"{key}.") for key in keys for name in names)
    ]


# -- presets and files ----------------------------------------------------------------------------


def preset_text(name: str) -> str:
    """The TOML text of a preset as it ships."""
    return (files("ultratight") / "presets" / f"{name}.toml").read_text(encoding="utf-8")


def preset_tree(name: str) -> dict[str, Any]:
    """A preset with all that it extends, not validated (quick: nothing compiled is loaded)."""
    return config.resolved(name, PRESETS, preset_text, _relative_to)


def load(name_or_path: str | Path, overrides: Mapping[str, Any] | Iterable[str] = ()) -> Scenario:
    """A preset or a TOML file, with dotted overrides laid over it.

    A file may say ``extends = "jump-1"`` (a preset, or a file relative to itself) and give only
    what differs: tables merge key by key, lists are replaced.  A navigation file is looked for
    relative to the file that names it.  Raises `InvalidInput` with every problem found.
    """
    tree = _changed(
        config.resolved(str(name_or_path), PRESETS, preset_text, _relative_to),
        config.nest(overrides),
    )
    source = "" if str(name_or_path) in PRESETS else str(name_or_path)
    scenario = Scenario.from_dict(tree, source)
    lines = named_files.problems(scenario.to_dict())
    if lines:
        raise InvalidInput(lines)
    return scenario


def _changed(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with changes laid over it; of another world, title and reason no longer hold."""
    tree = config.merge(base, changes)
    same = {"name", "title", "why", "front_end", "correlator", "receiver"}
    touched = [key for key in changes if key not in same and tree[key] != base.get(key)]
    if not touched:
        return tree
    fresh = {"title": f"{base['name']}, changed: {', '.join(touched)}", "why": ""}
    return tree | fresh | {key: changes[key] for key in fresh if key in changes}


def _relative_to(folder: Path, tree: dict[str, Any]) -> dict[str, Any]:
    return named_files.moved(tree, lambda name: str(folder / name))
