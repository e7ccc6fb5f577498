"""C/N0 estimators on prompts drawn here: one bit in 20 ms, unit noise, perfect lock."""

import numpy as np
import pytest

from ultratight.tracking.cn0_estimators import limit_dbhz, m2m4, nwpr, snv

pytestmark = pytest.mark.nojit
CODE_S, BIT = 0.001, 20


def draw(cn0_dbhz, n_run, n_bit, seed, prompt_s=CODE_S, per_bit=BIT):
    """Prompts (n_run, n_bit * per_bit): sqrt(2 C/N0 T) times a bit, plus noise."""
    rng = np.random.default_rng(seed)
    shape = (n_run, n_bit * per_bit)
    bits = np.repeat(1.0 - 2.0 * rng.integers(0, 2, (n_run, n_bit)), per_bit, axis=1)
    noise = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    return np.sqrt(2.0 * 10.0 ** (cn0_dbhz / 10.0) * prompt_s) * bits + noise


def estimates(name, z):
    if name == "nwpr":
        return nwpr(z, CODE_S, BIT, 0)
    return {"m2m4": m2m4, "snv": snv}[name](z, CODE_S)


@pytest.mark.parametrize("cn0", [25.0, 30.0, 35.0, 40.0, 45.0, 50.0])
def test_the_limit_is_that_of_many_prompts(cn0):
    # 20 runs of 40 s, whose own spread says how well the mean is known; what a finite run adds goes
    # with the variance, in dB by 0.12 sd^2: 0.02 dB for M2M4 at 25 dB-Hz, nothing elsewhere
    z = draw(cn0, 20, 2000, 3)
    for name in ("nwpr", "m2m4", "snv"):
        found = estimates(name, z)
        error = 4.0 * found.std() / np.sqrt(20.0)
        assert error < (0.4 if (name, cn0) == ("m2m4", 25.0) else 0.1)
        limit = limit_dbhz(name, cn0, CODE_S)
        assert found.mean() == pytest.approx(limit, abs=error + 0.12 * found.std() ** 2 + 1e-3)


def test_biases_in_one_second():
    # M 20, K 50: -0.11 dB at 30 dB-Hz, 0 at 45, spread 0.24 and 0.15 dB, by an independent
    # Monte Carlo; 4 sigma of 1000 runs here and a digit there
    for cn0, bias, spread in ((30.0, -0.11, 0.24), (45.0, 0.0, 0.15)):
        found = nwpr(draw(cn0, 1000, 50, 5), CODE_S, BIT, 0) - cn0
        assert found.mean() == pytest.approx(bias, abs=4.0 * spread / np.sqrt(1000.0) + 0.01)
        assert found.std() == pytest.approx(spread, rel=0.1)


def test_snv_reads_high_where_noise_folds():
    # +0.3 dB at 20 dB-Hz with 50 prompts of 20 ms, by an independent Monte Carlo: A^2 = 4
    found = snv(draw(20.0, 4000, 50, 8, prompt_s=0.02, per_bit=1), 0.02) - 20.0
    assert found.mean() == pytest.approx(0.3, abs=0.05)
    assert 0.15 < limit_dbhz("snv", 20.0, 0.02) - 20.0 < found.mean()
    assert limit_dbhz("snv", 45.0, 0.02) == pytest.approx(45.0, abs=1e-6)
    # pure noise: (mean |I|)^2 = 2 / pi of 2
    noise = limit_dbhz("snv", -60.0, CODE_S)
    assert noise == pytest.approx(10.0 * np.log10(1.0 / (np.pi - 1.0) / CODE_S), abs=0.01)


def test_nothing_before_bit_synchronisation():
    z = draw(45.0, 3, 50, 1)
    assert np.isnan(nwpr(z, CODE_S, BIT, None)).all()
    # with edges in the wrong place it would be a wrong number: half of the bits change inside
    assert (nwpr(z, CODE_S, BIT, 10) < 40.0).all()
    # the others need no edges
    for name in ("m2m4", "snv"):
        assert np.abs(estimates(name, z[:, 7:-13]) - 45.0).max() < 2.0


def test_phase_matters_to_snv_alone():
    z = draw(45.0, 1, 500, 2)
    turned = z * np.exp(2j * np.pi * 0.125)
    np.testing.assert_allclose(m2m4(turned, CODE_S), m2m4(z, CODE_S), rtol=1e-12)
    np.testing.assert_allclose(nwpr(turned, CODE_S, BIT, 0), nwpr(z, CODE_S, BIT, 0), rtol=1e-12)
    assert snv(turned, CODE_S)[0] < 35.0


def test_moments_that_allow_no_answer():
    # noise alone: S^2 = 2 M2^2 - M4 is negative in half of the samples
    found = m2m4(draw(-100.0, 400, 50, 4), CODE_S)
    share = np.isnan(found).mean()
    assert abs(share - 0.5) < 4.0 * 0.5 / np.sqrt(400.0)
    assert np.isnan(nwpr(np.zeros((2, 100)), CODE_S, BIT, 0)).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: nwpr(np.ones(40), CODE_S, 1, 0), "bit_prompts is 1"),
        (lambda: nwpr(np.ones(40), CODE_S, BIT, 20), "first is 20"),
        (lambda: m2m4(np.ones(40), 0.0), "prompt_s is 0.0"),
        (lambda: snv(np.ones((3, 0)), CODE_S), r"prompts \(3, 0\)"),
        (lambda: limit_dbhz("beaulieu", 40.0, CODE_S), "estimator is 'beaulieu'"),
    ],
)
def test_calls_that_mean_nothing(call, message):
    with pytest.raises(ValueError, match=message):
        call()
