"""Keys of the scalar closures: loops, discriminators, phases of a channel, aiding."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from ultratight.tables import Table

if TYPE_CHECKING:
    from ultratight.scenario import Scenario

Found = list[tuple[tuple[str, ...], str]]
"""Keys concerned, and the line that says what is wrong"""
Seconds = Annotated[float, Field(ge=0.001, le=0.02)]
Hertz = Annotated[float, Field(gt=0.0, le=100.0)]
DllHertz = Annotated[float, Field(gt=0.0, le=20.0)]


class LoopKeys(Table):
    """What scalar closures alone are told."""

    integration_s: Seconds = 0.005
    """Scalar closures: coherent integration once pulled in; 1, 2, 4, 5, 10 or 20 ms"""
    bandwidth_hz: Hertz = 18.0
    """Scalar closures: noise bandwidth of the PLL"""
    pll_order: Literal[2, 3] = 3
    fll_bandwidth_hz: Annotated[float, Field(ge=0.0, le=20.0)] = 2.0
    """Of the FLL that assists the PLL until it has locked, at 20 ms; 0 for none"""
    dll_bandwidth_hz: DllHertz = 1.0
    dll_order: Literal[1, 2] = 1
    fll_order: Literal[1, 2] | None = None
    """Scalar closures; by default one less than ``pll_order``"""
    loop: Literal["filters", "kalman"] = "filters"
    """Scalar closures, after pull-in: loop filters, or a Kalman filter per channel"""
    carrier_loop: Literal["pll", "fll-pll", "fll"] = "pll"
    """Scalar closures, once locked: the PLL, an FLL beside it, or an FLL alone"""
    code_discriminator: Literal["dot-product", "coherent", "power", "envelope"] = "dot-product"
    carrier_discriminator: Literal["atan", "atan2", "decision-directed", "product"] = "atan"
    """atan2: data bits are known and wiped off; the others are blind to their signs"""
    frequency_discriminator: Literal["atan2", "decision-directed", "cross"] = "atan2"
    cn0_estimator: Literal["nwpr", "m2m4", "snv"] = "nwpr"
    """NWPR of 1 ms prompts in a data bit, M2M4 or SNV of the bits' prompts; low pass of 1 s"""
    code_carrier_limit_mps: Annotated[float, Field(gt=0.0, le=100.0)] | None = None
    """Lock is lost where code and carrier diverge faster; left out: never"""
    pull_in_bandwidth_hz: DllHertz = 5.0
    """Pull-in: of the FLL"""
    pull_in_dll_bandwidth_hz: DllHertz | None = None
    """Pull-in, on single code periods; by default ``dll_bandwidth_hz``"""
    assisted_integration_s: Seconds | None = None
    """FLL-assisted PLL; by default ``integration_s``"""
    assisted_bandwidth_hz: Hertz | None = None
    """FLL-assisted PLL; by default ``bandwidth_hz``, 12 Hz at least"""
    assisted_dll_bandwidth_hz: DllHertz | None = None
    """By default ``dll_bandwidth_hz``"""
    jerk_mps3_sqrt_hz: Annotated[float, Field(ge=0.0, le=1e4)] = 3.0
    """Kalman loop: white jerk along the line of sight that it expects"""
    divergence_m_sqrt_s: Annotated[float, Field(ge=0.0, le=100.0)] = 0.1
    """Kalman loop: random walk of code against carrier"""
    aiding_latency_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """scalar-ins: the IMU's increments reach the receiver so late; their time stamps are right"""
    aiding_clock: Literal["first", "learnt"] = "first"
    """scalar-ins: clock drift of the aid, that of the start or what the loops have in common"""


def loop_contradictions(s: Scenario) -> Found:
    """What the loops of a scalar closure cannot do."""
    from ultratight.tracking.loop_design import EPOCH_S, INTEGRATIONS_MS
    from ultratight.tracking.loop_filters import BANDWIDTH_T_LIMIT

    r = s.receiver
    found: Found = []

    def refuse(keys: str, given: object, expected: str) -> None:
        names = tuple(f"receiver.{key}" for key in keys.split())
        found.append((names, f"{names[0]}: {given} given, expected {expected}"))

    first_s = r.integration_s if r.assisted_integration_s is None else r.assisted_integration_s
    for name, t in (("integration_s", r.integration_s), ("assisted_integration_s", first_s)):
        said = name == "integration_s" or first_s != r.integration_s
        if not said or any(abs(t - 0.001 * ms) < 1e-9 for ms in INTEGRATIONS_MS):
            continue
        known = ", ".join(f"{0.001 * ms:g}" for ms in INTEGRATIONS_MS)
        refuse(name, f"{t:g}", f"one of {known} (parts of a data bit)")
    for name, value, of, t in (
        ("bandwidth_hz", r.bandwidth_hz, "integration_s", r.integration_s),
        ("dll_bandwidth_hz", r.dll_bandwidth_hz, "integration_s", r.integration_s),
        ("assisted_bandwidth_hz", r.assisted_bandwidth_hz, "assisted_integration_s", first_s),
        (
            "assisted_dll_bandwidth_hz",
            r.assisted_dll_bandwidth_hz,
            "assisted_integration_s",
            first_s,
        ),
    ):
        if value is not None and value * t > BANDWIDTH_T_LIMIT + 1e-9:
            most = (
                f"at most {BANDWIDTH_T_LIMIT:g} / {of} = {BANDWIDTH_T_LIMIT / t:g}, for stability"
            )
            refuse(f"{name} {of}", f"{value:g}", most)
    if r.closure not in ("scalar", "scalar-ins"):
        return found
    alone = r.carrier_loop == "fll"
    if r.fll_order is not None and r.fll_order >= r.pll_order and not alone:
        refuse("fll_order pll_order", r.fll_order, f"less than pll_order = {r.pll_order}")
    if alone and r.fll_bandwidth_hz == 0.0:
        refuse("fll_bandwidth_hz carrier_loop", 0, 'more than 0 with carrier_loop = "fll"')
    if alone and r.code_discriminator == "coherent":
        refuse("code_discriminator carrier_loop", '"coherent"', "another one without a PLL")
    if alone and r.cn0_estimator == "snv":
        refuse("cn0_estimator carrier_loop", '"snv"', "another one without a PLL")
    if r.loop == "kalman" and r.carrier_loop != "pll":
        refuse("loop carrier_loop", '"kalman"', 'carrier_loop = "pll": it has no FLL beside it')
    if r.carrier_discriminator == "atan2" and not r.knows.data_bits:
        refuse(
            "carrier_discriminator knows.data_bits", '"atan2"', "receiver.knows.data_bits = true"
        )
    lag = r.aiding_latency_s / EPOCH_S
    if abs(lag - round(lag)) > 1e-6:
        refuse("aiding_latency_s", f"{r.aiding_latency_s:g}", f"a multiple of {EPOCH_S:g} s")
    return found
