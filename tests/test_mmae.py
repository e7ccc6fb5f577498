"""SINS/CNS of a ballistic missile: acceptance figures (specification, B9) on seeds of its own."""

from types import SimpleNamespace

import numpy as np
import pytest

SEEDS = range(9201, 9205)


@pytest.fixture(scope="module")
def study(studies):
    return studies(flight="common.star_flight", cells="common.star_cells", script="mmae")


def flown(study, cell, names, seeds=SEEDS):
    """Merits (run, ..) of some filters of a cell over the same worlds."""
    setting, filters = study.cells.CELLS[cell]
    runs = []
    for seed in seeds:
        world = study.flight.draw(seed, setting)
        runs.append(
            {n: study.cells.merits(world, study.flight.estimate(world, filters[n])) for n in names}
        )
    return study.cells.stacked(runs)


def rms(m, name, part=0):
    return float(np.sqrt(m[name]["settled"][:, part].mean()))


def gain(m, name):
    return 100.0 * (1.0 - rms(m, name) / rms(m, "EKF"))


def scale(study, m, name, t):
    return m[name]["scale"][:, study.cells.TIMES.index(t)].mean()


def test_noises_are_the_printed_ones(study):
    """B9.2: wgt0 = 2.4241e-06 rad/s and wga0 = 4.8902e-04 m/s2, to five digits."""
    assert f"{study.flight.WGT0:.4e}" == "2.4241e-06"
    assert f"{study.flight.WGA0:.4e}" == "4.8902e-04"


def test_bank_is_a_hammersley_set(study):
    """B5: a uniform grid in the gyros' noise, the base-2 radical inverse beside it."""
    np.testing.assert_allclose(study.cells.TEN[:, 0], 0.3625 + 0.225 * np.arange(10))
    inverse = [0.0, 0.5, 0.25, 0.75, 0.125, 0.625, 0.375, 0.875, 0.0625, 0.5625]
    np.testing.assert_allclose(study.cells.TEN[:, 1], 0.25 + 2.25 * (np.array(inverse) + 0.05))


def test_misalignment_of_arc_minutes(study):
    """B9.3, 5 and 8."""
    m = flown(study, "arcmin", ("EKF", "UKF", "MMAE-EKF", "MMAE-UKF", "true Q", "no floor"))
    single = np.sqrt(m["UKF"]["settled"] / m["EKF"]["settled"])
    np.testing.assert_allclose(single, 1.0, rtol=1e-3)
    assert 38e-6 < rms(m, "EKF") < 42e-6
    for name in ("MMAE-EKF", "MMAE-UKF"):
        assert 9.0 < gain(m, name) < 13.0, name
        assert gain(m, name) < gain(m, "true Q") + 0.5, name
        assert 0.4 < scale(study, m, name, 500) < 0.7, name
        assert 1.7 < scale(study, m, name, 750) < 2.3, name
    assert scale(study, m, "no floor", 600) < 1.3
    assert gain(m, "no floor") < 6.0
    assert 0.97 < m["true Q"]["nis"].mean() < 1.03
    normalised = {n: np.sqrt(m[n]["normalised"].mean(0)) for n in ("MMAE-EKF", "EKF")}
    assert np.all((normalised["MMAE-EKF"] > 0.8) & (normalised["MMAE-EKF"] < 1.2))
    assert normalised["EKF"][0] < 0.9
    assert normalised["EKF"][1] > 1.3
    assert not any(x["mishaps"].any() for x in m.values())


def test_misalignment_of_degrees(study):
    """B9.4; the iterated filter is what the linearisation of the first fix costs."""
    m = flown(study, "deg", ("EKF", "UKF", "MMAE-EKF", "MMAE-UKF", "iterated EKF"))
    order = [rms(m, n) for n in ("EKF", "UKF", "MMAE-EKF", "MMAE-UKF")]
    assert order == sorted(order, reverse=True)
    assert 0.5 < gain(m, "UKF") < 3.0
    assert 10.0 < gain(m, "MMAE-UKF") < 14.0
    assert rms(m, "iterated EKF", 1) < rms(m, "UKF", 1)
    assert not any(x["mishaps"].any() for x in m.values())


def test_report_puts_table_2_beside_ours(study):
    """B9.9, on figures that are made up: r.m.s. of roll, heading, pitch of 1, 2 and 3e-4 rad."""
    said, ones = [], np.ones((2, len(study.cells.TIMES)))
    made_up = {"all": np.full((2, 3), np.square([1e-4, 2e-4, 3e-4])), "settled": 1e-9 * ones[:, :3],
               "scale": ones, "normalised": ones[:, :2]}  # fmt: skip
    cells = {c: filters for c, (_, filters) in study.cells.CELLS.items()}
    m = {f"{c} {n}": made_up for c, filters in cells.items() for n in filters}
    m |= {f"100 Hz {n}": made_up for n in study.cells.FOUR}
    study.script.tabulate(SimpleNamespace(say=said.append), m)
    text = "\n".join(said)
    assert "Absolute values are not comparable" in text
    for name, theirs in (
        ("EKF", "6.8013 8.2337 8.2276"), ("UKF", "6.7563 8.1998 8.1969"),
        ("MMAE-EKF", "6.7462 8.1934 8.1977"), ("MMAE-UKF", "6.7420 8.1894 8.1898"),
    ):  # fmt: skip
        assert f"{name:10} {theirs}    2.0000 3.0000 1.0000" in text


def test_accelerometers_noise_is_not_observed(study):
    """B9.7: all wga equal changes neither attitude nor weights (1e-12)."""
    world = study.flight.draw(SEEDS[0])
    a, b = (
        study.flight.estimate(world, study.cells.CELLS["arcmin"][1][n])
        for n in ("MMAE-EKF", "equal wga")
    )
    np.testing.assert_allclose(a.run.weight, b.run.weight, atol=1e-12)
    np.testing.assert_allclose(a.turn, b.turn, atol=1e-12)
    assert not np.array_equal(a.run.variance[:, 6], b.run.variance[:, 6])


def test_same_seed_same_bits_and_fixes_may_be_missing(study):
    """An outage of 100 s in the quiet half: the bias holds the attitude, errors stay in 5 sigma."""
    world = study.flight.draw(SEEDS[0])
    world.z[2000:3000] = np.nan
    one, two = (study.flight.estimate(world, study.cells.FOUR["MMAE-UKF"]) for _ in range(2))
    np.testing.assert_array_equal(one.run.mean, two.run.mean)
    sigma = np.sqrt(one.run.variance[2999, :3])
    assert np.all(sigma > 2.0 * np.sqrt(one.run.variance[1999, :3]))
    assert np.all(np.abs(one.turn[3000]) < 5.0 * sigma)
    assert np.all(np.abs(one.turn[3050]) < 5.0 * np.sqrt(one.run.variance[3049, :3]))


@pytest.mark.campaign
def test_fixes_at_100_hz(study):
    """B9.6: all-epoch r.m.s. to 2 % and all four filters within 1.5 %, one seed as there."""
    world = study.flight.draw(SEEDS[0], study.flight.Setting("deg", star_hz=100))
    found = {
        n: study.cells.merits(world, study.flight.estimate(world, a))
        for n, a in study.cells.FOUR.items()
    }
    each = np.sqrt([x["all"] for x in found.values()])
    np.testing.assert_allclose(each, [[5.5e-4, 3.35e-4, 5.5e-4]] * 4, rtol=0.02)
    assert np.all(each.max(axis=0) / each.min(axis=0) < 1.015)
    gained = 1.0 - np.sqrt(found["MMAE-UKF"]["settled"][0] / found["EKF"]["settled"][0])
    assert 0.08 < gained < 0.14  # 11.1 % there
