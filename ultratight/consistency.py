"""Rules that join several keys of a scenario, and what is allowed but seldom wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal

from signals.constants import CA_CHIP_RATE_HZ
from ultratight import config
from ultratight.filters import own
from ultratight.loop_keys import Found, loop_contradictions

if TYPE_CHECKING:
    from ultratight.scenario import Scenario

Label = Literal["L1CA", "L1CD", "L1CP", "L2CM", "L2CL", "L5I", "L5Q", "E5AI", "E5AQ", "E1B", "E1C"]
"""Signals of the satellites that there are orbits for, see `signals.codes`"""
TIGHT = ("ultra-tight", "federated")
"""Closures of INS and a filter of one's choice"""
ROW_S = 0.02
"""Closures of 1 ms epochs keep a row this often"""
NODE_S = 0.005
"""Spacing of the nodes of the truth"""
LARGEST_FAULT_M = 1e5
VIBRATION_LIMIT_HZ = 50.0
VIBRATION_RISE_S = 0.5
"""Rise and fall together"""
SPEED_LIMIT_MPS = 12_000.0
"""No vehicle of ours is faster than escape velocity"""


def contradictions(s: Scenario) -> Found:
    """(keys concerned, what is wrong) for every rule that joins several keys."""
    front_end, receiver, found = s.front_end, s.receiver, []
    rate = front_end.sample_rate_hz

    def refuse(keys: str, given: object, expected: str) -> None:
        names = tuple(keys.split())
        found.append((names, f"{names[0]}: {given} given, expected {expected}"))

    if rate < CA_CHIP_RATE_HZ:
        refuse(
            "front_end.sample_rate_hz", f"{rate:g}", f"at least the chip rate {CA_CHIP_RATE_HZ:g}"
        )
    if abs(front_end.if_hz) >= rate / 2:
        refuse(
            "front_end.if_hz front_end.sample_rate_hz",
            f"{front_end.if_hz:g}",
            f"less than half the sample rate ({rate / 2:g}) in magnitude",
        )
    tight, federated = receiver.closure in TIGHT, receiver.closure == "federated"
    key = "receiver.federated.update_s" if federated else "receiver.epoch_s"
    epoch = receiver.federated.update_s if federated else receiver.epoch_s
    if not _is_multiple(receiver.vector.update_s, ROW_S):
        update = f"{receiver.vector.update_s:g}"
        refuse("receiver.vector.update_s", update, f"a multiple of {ROW_S:g} s, a data bit")
    if receiver.closure in ("vdll", "vdfll") and receiver.loop == "kalman":
        refuse("receiver.loop receiver.closure", '"kalman"', '"filters" in a vector closure')
    if not tight and not _is_multiple(s.duration_s, ROW_S):
        refuse("duration_s", f"{s.duration_s:g}", f"a multiple of {ROW_S:g} s, a data bit")
    if tight and not _is_multiple(s.duration_s, epoch):
        name = key.rpartition(".")[2]
        refuse(f"duration_s {key}", f"{s.duration_s:g}", f"a multiple of {name} = {epoch:g}")
    if tight and not _is_multiple(epoch, 1.0 / s.imu.rate_hz):
        refuse(
            f"{key} imu.rate_hz",
            f"{epoch:g}",
            f"a multiple of the IMU interval {1.0 / s.imu.rate_hz:g} s",
        )
    for name in ("bit_edges", "ephemerides", "initial_state"):
        if not getattr(receiver.knows, name):
            refuse(
                f"receiver.knows.{name}",
                "false",
                "true: acquisition, bit synchronisation and decoding are not built yet",
            )
    if s.correlator.multiple_access and s.correlator.kind == "samples":
        refuse(
            "correlator.multiple_access correlator.kind",
            "true",
            'kind = "model": samples hold the other satellites themselves',
        )
    coherent = tight and receiver.measurement != "differential"
    if coherent and not receiver.knows.data_bits and not _all_pilots(s):
        refuse(
            "receiver.measurement receiver.knows.data_bits",
            f'"{receiver.measurement}" without receiver.knows.data_bits',
            'data_bits = true, "differential", or signals that are pilots',
        )
    if federated:
        found += _federated_contradictions(s)
    if s.jump_window_s and not s.jump_window_s[0] < s.jump_window_s[1] <= s.duration_s:
        refuse(
            "jump_window_s duration_s", config.show(s.jump_window_s), "start < end <= duration_s"
        )
    times = [t for t, _ in s.channel.cn0_profile_s_db]
    if any(b <= a for a, b in zip(times, times[1:], strict=False)):
        refuse("channel.cn0_profile_s_db", config.show(times), "times that grow")
    if s.climb_deg and s.plane == "horizontal":
        refuse("climb_deg plane", f"{s.climb_deg:g}", 'plane = "vertical" with it')
    if s.trajectory is not None and s.plane == "vertical":
        refuse("trajectory plane", config.show(s.trajectory), 'plane = "horizontal" beside it')
    if s.trajectory is not None and s.profile:
        refuse("trajectory profile", config.show(s.trajectory), "no profile beside it: profile=[]")
    if s.prns is not None and len(set(s.prns)) < len(s.prns):
        refuse("prns", config.show(s.prns), "each satellite once")
    parts = (
        _unknown_names, _signal_contradictions, loop_contradictions, _profile_contradictions,
        _vibration_contradictions, _disturbance_contradictions,
    )  # fmt: skip
    return found + [line for part in parts for line in part(s)]


def _federated_contradictions(s: Scenario) -> Found:
    """Measurements and filters that the pre-filters leave no room for."""
    from ultratight.filters.catalog import reads_taps

    found: Found = []
    if s.receiver.measurement == "half-bits":
        keys = "receiver.measurement", "receiver.closure"
        text = '"half-bits" given, expected "coherent" or "differential" with closure federated'
        found.append((keys, f"{keys[0]}: {text}: its pre-filters take half bits in any case"))
    if reads_taps(s.receiver.filter):
        keys = "receiver.filter", "receiver.closure"
        text = f'"{s.receiver.filter}" given, expected a filter that does not look into the taps'
        found.append((keys, f"{keys[0]}: {text}: with closure federated it is given ranges"))
    return found


def _all_pilots(s: Scenario) -> bool:
    from signals.codes import PILOTS

    return bool(s.signals) and set(s.signals) <= PILOTS


def _signal_contradictions(s: Scenario) -> Found:
    """What cannot be done with these signals."""
    found: Found = []

    def refuse(keys: str, given: str, expected: str) -> None:
        names = tuple(keys.split())
        found.append((names, f"{names[0]}: {given} given, expected {expected}"))

    labels, sky = s.signals, s.constellation
    shown = ", ".join(labels)
    if not labels:
        refuse("signals", "nothing", "at least one signal")
    if len(set(labels)) < len(labels):
        refuse("signals", shown, "each signal once")
    foreign = [x for x in labels if x.startswith("E") != (sky == "galileo-24")]
    if foreign:
        system = "Galileo" if sky == "galileo-24" else "GPS"
        refuse("signals constellation", ", ".join(foreign), f'signals of {system} with "{sky}"')
    if {"E1B", "E1C"} & set(labels) and s.galileo_codes is None:
        refuse("galileo_codes signals", "nothing", "the file of the memory codes of E1B and E1C")
    if labels in ((), ("L1CA",)):
        return found
    from signals.codes import facts

    if s.receiver.closure not in TIGHT:
        refuse(
            "receiver.closure signals",
            f'"{s.receiver.closure}" with signals {shown}',
            '"ultra-tight", or L1CA alone',
        )
    if s.data_bits == "lnav" and not _all_pilots(s):
        refuse(
            "data_bits signals", f'"lnav" with signals {shown}', '"random": LNAV is that of L1CA'
        )
    if s.correlator.kind == "samples":
        found += _sampling_contradictions(s)
    if s.correlator.multiple_access:
        refuse("correlator.multiple_access signals", f"true with signals {shown}", "L1CA alone")
    spacing = s.correlator.spacing_chips
    for label in labels:
        if facts(label).modulation.early_late_slope(spacing) < 1.0 - 1e-9:
            refuse(
                "correlator.spacing_chips signals",
                f"{spacing:g} with {label}",
                "a spacing at which late minus early grows with the delay by 1 per chip or more "
                "(BOC: less than 0.5; TMBOC and CBOC also not near 0.125 and 0.3)",
            )
    return found


def _sampling_contradictions(s: Scenario) -> Found:
    """What one stream of IF samples cannot hold."""
    from signals.codes import facts

    rows = [facts(label) for label in s.signals]
    found: Found = []
    other = next((row for row in rows if row.carrier_hz != rows[0].carrier_hz), None)
    if other is not None:
        first, second = (f"{row.label} at {row.carrier_hz / 1e6:g} MHz" for row in (rows[0], other))
        text = f'signals: {first} and {second} given, expected one carrier in samples, or "model"'
        found.append((("signals", "correlator.kind"), text))
    rate, most = s.front_end.sample_rate_hz, max(rows, key=lambda row: row.sub_chip_rate_hz)
    if CA_CHIP_RATE_HZ <= rate < most.sub_chip_rate_hz:
        key = "front_end.sample_rate_hz"
        kind = "chip" if most.per_chip == 1 else "sub-chip"
        text = (
            f"{key}: {rate:.10g} given, expected at least the {kind} rate of {most.label}, "
            f"{most.sub_chip_rate_hz:.10g}"
        )
        found.append(((key, "signals", "correlator.kind"), text))
    return found


def names() -> dict[str, Mapping[str, Any]]:
    """What may stand at keys that name a row of a table elsewhere.

    Looked up late: those modules are slow to load.
    """
    from signals.clock import OSCILLATORS
    from ultratight.filters.catalog import CATALOG
    from ultratight.ins.imu import GRADES

    return {
        "receiver.filter": CATALOG,
        "imu.grade": GRADES,
        "clock.model": OSCILLATORS,
        "receiver.process_noise.clock_model": OSCILLATORS,
    }


def _unknown_names(s: Scenario) -> Found:
    given = {
        "receiver.filter": s.receiver.filter,
        "imu.grade": s.imu.grade,
        "clock.model": s.clock.model,
        "receiver.process_noise.clock_model": s.receiver.process_noise.clock_model,
    }
    found: Found = []
    if own.is_own(s.receiver.filter):
        del given["receiver.filter"]
        try:
            own.split(s.receiver.filter)
        except ValueError as error:
            found = [(("receiver.filter",), f"receiver.filter: {error}")]
    return found + [
        ((key,), f'{key}: "{given[key]}" given, expected one of {", ".join(table)}')
        for key, table in names().items()
        if given.get(key) is not None and given[key] not in table
    ]


def _profile_contradictions(s: Scenario) -> Found:
    found: Found = []
    end, speed, fastest = 0.0, s.speed_mps, abs(s.speed_mps)
    for i, leg in enumerate(s.profile):
        if leg.t1_s <= leg.t0_s:
            text = f"profile[{i}].t1_s: {leg.t1_s:g} given, expected more than t0_s = {leg.t0_s:g}"
            found.append((("profile",), text))
        if leg.t0_s < end:
            text = (
                f"profile[{i}].t0_s: {leg.t0_s:g} given, expected {end:g} or more (order, overlap)"
            )
            found.append((("profile",), text))
        if leg.t1_s > s.duration_s:
            text = f"profile[{i}].t1_s: {leg.t1_s:g} given, expected at most duration_s"
            text += f" = {s.duration_s:g} (no profile at all: --set 'profile=[]')"
            found.append((("profile", "duration_s"), text))
        end = max(end, leg.t1_s)
        length, a0, a1 = leg.t1_s - leg.t0_s, leg.accel0_mps2, leg.accel1_mps2
        if a0 * a1 < 0.0:  # the extreme speed is where the acceleration crosses zero
            fastest = max(fastest, abs(speed + a0 * a0 / (a0 - a1) * length / 2.0))
        speed += (a0 + a1) / 2.0 * length
        fastest = max(fastest, abs(speed))
    if not found and fastest > SPEED_LIMIT_MPS:
        text = f"profile: reaches {fastest:g} m/s, expected at most {SPEED_LIMIT_MPS:g} m/s"
        found.append((("profile", "speed_mps"), text))
    return found


def _vibration_contradictions(s: Scenario) -> Found:
    found: Found = []
    for i, v in enumerate(s.vibration):
        least = v.t0_s + VIBRATION_RISE_S
        for key, given, wrong, expected in (
            ("t1_s", v.t1_s, v.t1_s < least, f"at least t0_s + {VIBRATION_RISE_S:g} = {least:g}"),
            ("t1_s", v.t1_s, v.t1_s > s.duration_s, f"at most duration_s = {s.duration_s:g}"),
            ("to_hz", v.to_hz, v.to_hz <= v.from_hz, f"more than from_hz = {v.from_hz:g}"),
        ):
            if wrong:
                text = f"vibration[{i}].{key}: {given:g} given, expected {expected}"
                found.append((("vibration", "duration_s"), text))
    return found


def _disturbance_contradictions(s: Scenario) -> Found:
    found: Found = []
    for i, d in enumerate(s.channel.disturbance):
        row = f"channel.disturbance[{i}]"

        def refuse(key: str, given: str, expected: str, row: str = row) -> None:
            name = f"{row}.{key}" if key else row
            keys = ("channel.disturbance", "duration_s")
            found.append((keys, f"{name}: {given} given, expected {expected}"))

        end = s.duration_s if d.t1_s is None else d.t1_s
        if d.t1_s is not None and d.t1_s <= d.t0_s:
            refuse("t1_s", f"{d.t1_s:g}", f"more than t0_s = {d.t0_s:g}")
        elif d.t0_s >= s.duration_s:
            refuse("t0_s", f"{d.t0_s:g}", f"less than duration_s = {s.duration_s:g}")
        elif end > s.duration_s:
            refuse("t1_s", f"{end:g}", f"at most duration_s = {s.duration_s:g}")
        for key, t in (("t0_s", d.t0_s), ("t1_s", d.t1_s)):
            if t and not _is_multiple(t, NODE_S):
                refuse(key, f"{t:.9g}", f"a multiple of {NODE_S:g} s")
        if d.prns is not None and (not d.prns or len(set(d.prns)) < len(d.prns)):
            refuse("prns", config.show(d.prns), "some satellites, each once; left out: all")
        if d.elevation_deg is not None and not d.elevation_deg[0] < d.elevation_deg[1]:
            refuse("elevation_deg", config.show(d.elevation_deg), "the lower one first")
        if d.azimuth_deg is not None and (d.azimuth_deg[1] - d.azimuth_deg[0]) % 360.0 == 0.0:
            refuse("azimuth_deg", config.show(d.azimuth_deg), "two directions; left out: all")
        if not (d.cn0_change_db or d.pseudorange_m or d.pseudorange_rate_mps):
            change = "cn0_change_db, pseudorange_m or pseudorange_rate_mps other than zero"
            refuse("", "no change", change)
        last = d.pseudorange_m + d.pseudorange_rate_mps * (end - d.t0_s)
        if abs(last) > LARGEST_FAULT_M:
            refuse(
                "pseudorange_rate_mps",
                f"{d.pseudorange_rate_mps:g}",
                f"a fault of at most {LARGEST_FAULT_M:g} m at the end, not {last:g}",
            )
    return found


def _is_multiple(value: float, step: float) -> bool:
    return round(value / step) >= 1 and abs(value / step - round(value / step)) < 1e-6


def commensurate(sample_rate_hz: float, labels: Sequence[str]) -> list[str]:
    """Samples per chip p/q with q <= 10 put the chip edges on the sample grid at q phases only.

    With a sub-carrier the edges are those of sub-chips.  Close counts: the pattern must move by
    less than half its own step (1/q sample) in one code period.  A delay is then seen in steps of
    1/q sample, until Doppler moves the pattern.
    """
    from signals.codes import facts

    found = []
    for row in map(facts, labels):
        ratio = sample_rate_hz / row.sub_chip_rate_hz
        near = Fraction(ratio).limit_denominator(10)
        moves = abs(ratio - near) * row.length_chips * row.per_chip
        if moves >= 0.5 / near.denominator:
            continue
        chip = "chip" if row.per_chip == 1 else "sub-chip"
        of, other = f" of {row.label}", ""
        if row.label == "L1CA":
            of, other = "", "; 4e6 (4000/1023) does not"
        found.append(
            f"front_end.sample_rate_hz: {sample_rate_hz:g} is {near} samples per {chip}{of}: the "
            f"{chip} edges meet the sample grid at {near.denominator} phase(s) only, which biases "
            f"code delay{other}"
        )
    return found
