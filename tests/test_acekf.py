"""SINS/GNSS with anomalies: acceptance figures of the specification (A10) on seeds of its own."""

from pathlib import Path

import numpy as np
import pytest

STUDIES = Path(__file__).parents[1] / "studies"
SEEDS = range(9101, 9106)


@pytest.fixture(scope="module")
def study():
    """The study's scenario and filters; its folder is on no path but its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(STUDIES)
        import acekf

        yield acekf


def twelve(study, name, world):
    return study.merits(study.fly(world, study.FILTERS[name]))


def flown(study, names, sizes, kind):
    """Merits (run, ..) of filters over the same worlds."""
    runs = [
        {n: twelve(study, n, world) for n in names}
        for world in (study.draw(seed, sizes, kind) for seed in SEEDS)
    ]
    return {n: {k: np.array([r[n][k] for r in runs]) for k in runs[0][n]} for n in names}


def gain(m, over):
    both = [m[n]["twelve"].mean(0) for n in ("ACEKF", over)]
    return 100.0 * (1.0 - both[0] / both[1])


def test_flight_ends_where_the_prototype_s_does(study):
    """A10.1: 34.79567, 108.46615 deg to 1e-5, 2002.53 m to 0.01; no error without errors."""
    from common.sins_flight import path

    true = path()
    np.testing.assert_allclose(np.degrees(true.p[-1, :2]), [34.79567, 108.46615], atol=1e-5)
    assert true.p[-1, 2] == pytest.approx(2002.53, abs=0.01)
    world = study.draw(1, "none")
    perfect = world._replace(
        alpha=true.alpha, nu=true.nu, first=np.zeros(15), gnss=np.full((1000, 6), np.nan)
    )
    error = np.abs(study.fly(perfect, study.FILTERS["ACEKF"]).error).max(0)
    assert error[:3].max() < 1e-9
    assert error[3:].max() < 1e-3


def test_correlated_anomalies(study):
    """A10.3, 4 and 5."""
    names = ("EKF", "REKF", "REKF 50", "AEKF", "AEKF 50", "ACEKF")
    m = flown(study, names, "T1", "ar")
    shares = m["ACEKF"]["classes"].mean(0)
    assert shares[[0, 3], 2].min() >= 0.95
    assert shares[[1, 2, 4, 5], 1].min() >= 0.90
    assert m["EKF"]["twelve"][:, 9:].mean(0).min() > 80.0
    assert m["ACEKF"]["twelve"][:, 9:].mean(0).max() < 10.0
    assert gain(m, "EKF").mean() >= 94.0
    assert gain(m, "EKF").min() >= 90.0
    assert abs(gain(m, "REKF").mean()) <= 15.0
    assert -10.0 <= gain(m, "AEKF").mean() <= 25.0
    assert 15.0 <= gain(m, "REKF 50").mean() <= 45.0
    assert 45.0 <= gain(m, "AEKF 50").mean() <= 70.0


@pytest.mark.campaign
@pytest.mark.parametrize(("kind", "least"), [("white", 86.0), ("bias", 88.0)])
def test_other_anomalies(study, kind, least):
    """A10.3 and 4."""
    m = flown(study, ("EKF", "ACEKF"), "T1", kind)
    assert gain(m, "EKF").mean() >= least
    shares = m["ACEKF"]["classes"].mean(0)
    assert shares[[0, 3], 2].min() >= 0.95
    assert shares[[1, 2, 4, 5], 1].min() >= 0.90


@pytest.mark.campaign
def test_without_anomalies_all_are_alike(study):
    """A10.2."""
    m = flown(study, ("EKF", "REKF", "AEKF", "ACEKF", "ACEKF, both"), "none", "ar")
    rmse = {n: x["twelve"][:, 6:].mean(0) for n, x in m.items()}
    for name, bound in (("REKF", 0.1), ("AEKF", 0.1), ("ACEKF", 0.1), ("ACEKF, both", 0.4)):
        assert np.all(np.abs(rmse[name] / rmse["EKF"] - 1.0) < bound), name
    assert np.all((rmse["EKF"][3:] > 1.0) & (rmse["EKF"][3:] < 4.0))
    assert 0.28 <= m["ACEKF"]["share_b"].mean() <= 0.42


@pytest.mark.campaign
def test_exchanged_classes_ruin_the_filter(study):
    """A10.6: five times on every axis."""
    worlds = [study.draw(seed, "BASE", "white") for seed in SEEDS]
    swapped, right = (
        np.mean([study.merits(study.fly(w, f))["twelve"][9:] for w in worlds], axis=0)
        for f in (study.SWAPPED["ACEKF, swapped"], study.FILTERS["ACEKF"])
    )
    assert np.all(swapped > 5.0 * right)


def test_ud_is_the_plain_form_in_double_and_better_in_single(study):
    """A10.7: 1e-6 in every output; single precision with R x 1e-8: 1e-4 against 1e-2."""
    world = study.draw(SEEDS[0], "T1", "ar")
    ud, plain = (study.fly(world, f) for f in (study.FILTERS["ACEKF"], study.PLAIN["ACEKF, P"]))
    np.testing.assert_allclose(ud.error, plain.error, atol=1e-6)
    worst = study.precision(1e-8)
    assert worst["UD, double"] < 1e-10
    assert worst["UD, single"] < 1e-4
    assert worst["short, single"] > 1e-2
    assert worst["Joseph, single"] > 5.0 * worst["UD, single"]


def test_fixes_may_be_missing(study):
    """An outage of a minute: prediction alone, then as good as ever; same bits twice."""
    world = study.draw(SEEDS[0], "none")
    world.gnss[400:460] = np.nan
    one, two = (study.fly(world, study.FILTERS["ACEKF"]) for _ in range(2))
    np.testing.assert_array_equal(one.error, two.error)
    assert np.all(np.diff(one.sigma[400:460, 5]) > 0.0)
    assert np.abs(one.error[500:, 3:]).max() < 10.0
