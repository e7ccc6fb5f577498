"""Keys of the scalar closures: what they refuse, and where they arrive."""

import pytest

from ultratight import scenario
from ultratight.loop_keys import LoopKeys
from ultratight.scenario import InvalidInput
from ultratight.tracking.loop_design import ScalarSettings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (['code_discriminator="early"'], "receiver.code_discriminator"),
        (['carrier_loop="fll"', "fll_bandwidth_hz=0.0"], "receiver.fll_bandwidth_hz: 0 given"),
        (['carrier_loop="fll"', 'code_discriminator="coherent"'], "another one without a PLL"),
        (['carrier_loop="fll"', 'cn0_estimator="snv"'], "another one without a PLL"),
        (["fll_order=2", "pll_order=2"], "receiver.fll_order: 2 given, expected less than"),
        (['loop="kalman"', 'carrier_loop="fll-pll"'], 'receiver.loop: "kalman" given'),
        (['carrier_discriminator="atan2"', "knows.data_bits=false"], "data_bits = true"),
        (["assisted_integration_s=0.003"], "receiver.assisted_integration_s: 0.003 given"),
        (
            ["assisted_bandwidth_hz=90"],
            "receiver.assisted_bandwidth_hz: 90 given, expected at most",
        ),
        (["aiding_latency_s=0.0015"], "receiver.aiding_latency_s: 0.0015 given"),
        (["integration_s=0.003"], "receiver.integration_s: 0.003 given, expected one of"),
    ],
)
def test_what_is_refused(changes, message):
    with pytest.raises(InvalidInput) as refused:
        scenario.load("uniform", ['receiver.closure="scalar"', *(f"receiver.{c}" for c in changes)])
    assert any(message in line for line in refused.value.problems), refused.value.problems
    assert len(refused.value.problems) == 1


def test_every_key_has_its_setting():
    assert set(LoopKeys.model_fields) == set(ScalarSettings._fields)
    keys, settings = LoopKeys(), ScalarSettings()
    differ = {k for k in settings._fields if getattr(keys, k) != getattr(settings, k)}
    assert differ == {"integration_s"}  # 5 ms in a scenario
