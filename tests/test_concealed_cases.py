"""Concealed cases are hidden the way they say, healthy ones are healthy, and the public files hold no answer."""

import tomllib
from collections import Counter

import numpy as np
import pytest

from experiments import concealed
from experiments._concealed_effects import FAMILY, OUTSIDE
from experiments._concealed_files import answer, read_effects, read_setup, recording_file, simulation_file
from experiments._concealed_hiding import ABSORBED, CONFINED, MASKING, WAYS, clean_readings, displacement
from experiments._concealed_nature import drawn
from experiments._concealed_oracle import seen_rows
from experiments._concealed_plan import ALLOWED, REMAINDERS, Plan, plan
from experiments._concealed_seal import canonical

HEALTHY = Plan(1, True, "", "", False, "")


@pytest.fixture(scope="module")
def cases():
    """One case for each way that is quick to draw, and two healthy ones."""
    # Word, remainder, and a seed whose draw is quick.
    wishes = {
        "open": ("viscous_damping", "", 11), "noise": ("periodic_forcing", "", 9),
        "confined": ("impulse", "jitter", 11),
        "unread": ("constant_force", "", 9), "one_of_several": ("sensor_drift", "ripple", 5),
    }  # fmt: skip
    found = {}
    for number, (way, (word, remainder, seed)) in enumerate(wishes.items(), 1):
        found[way] = drawn(Plan(number, False, way, word, False, remainder), seed)
    return found | {f"healthy {k}": drawn(HEALTHY._replace(number=k), 5) for k in (11, 12)}


def whole(case):
    return (*case.effects, *case.remainder)


def check_claim(case):
    """A way's claim, computed anew from motions with and without the effect."""
    effect, claim = case.effects[0], case.claim
    clean = clean_readings(case.setup, case.effects)
    moved_by = displacement(case.setup, case.effects, case.effects[1:], clean)
    if case.plan.way == "noise":
        assert np.max(np.abs(moved_by)) < 1
    elif case.plan.way == "absorbed":
        assert claim.calibrated_over_noise <= ABSORBED and np.max(np.abs(moved_by)) > 3
    elif case.plan.way == "unread":
        place = case.setup.system.coordinates.index(effect.target)
        assert all(place not in r.sees for r in case.setup.readings)
    elif case.plan.way == "confined":
        assert 0 < claim.acting <= CONFINED
    elif case.plan.way == "one_of_several":
        others = [r.number for r in case.setup.records if r.number not in effect.recordings]
        bare = clean_readings(case.setup, case.effects[1:])
        assert others and all(np.array_equal(clean[n - 1], bare[n - 1]) for n in others)
    elif case.plan.way == "masked" and case.effects[1].word != "sensor_outliers":
        mask = displacement(case.setup, case.effects, case.effects[:1], clean)
        assert np.sqrt(np.mean(mask**2)) >= MASKING * np.sqrt(np.mean(moved_by**2))


def test_claims_hold(cases):
    """Every drawn case hides its effect the way it says."""
    for name, case in cases.items():
        if not name.startswith("healthy"):
            assert case.plan.way == name and case.effects
            check_claim(case)


@pytest.mark.slow  # a hundred draws
def test_claims_hold_for_the_whole_trial():
    """So do all of forty cases of another seed."""
    for item in plan(40, 9):
        case = drawn(item, 9)
        assert bool(case.effects) != item.healthy
        if not item.healthy:
            check_claim(case)


def test_healthy_cases_are_healthy(cases):
    """Nothing was left out: readings less the published simulation at the true start are the stated noise."""
    for name in ("healthy 11", "healthy 12"):
        case = cases[name]
        assert whole(case) == () and case.jitter == 0
        bare = clean_readings(case.setup, ())
        noise = np.array([case.setup.noise[r.column] for r in case.setup.readings])
        error = np.concatenate([((y - h) / noise).ravel() for y, h in zip(case.noisy, bare, strict=True)])
        error = error[np.isfinite(error)]
        # The variance of n readings with the kurtosis of Student's t of 5 degrees of freedom, 9: four standard errors.
        assert np.mean(error**2) == pytest.approx(1.0, abs=4 * np.sqrt(8 / len(error)))
        for column, stated in case.public.noise.items():
            assert stated == pytest.approx(case.setup.noise[column], rel=1e-3)
        for free in case.public.free:
            if free.sd is not None:
                assert abs(free.mean - case.setup.values[free.name]) < free.sd


def test_public_files_hold_no_answer(cases):
    """Names, effects and true values of what is calibrated stand in neither file; what is known is the truth."""
    for case in cases.values():
        simulation, recording = simulation_file(case), recording_file(case)
        table = tomllib.loads(simulation)
        for word in (*FAMILY, *OUTSIDE, *REMAINDERS, "absorbed", "masked", "unread", "confined", "healthy"):
            assert word not in simulation + recording
        for free in case.public.free:
            assert table["parameters"][free.name]["value"] == free.mean != case.setup.values[free.name]
        known = set(case.setup.values) - {f.name for f in case.public.free}
        assert all(table["parameters"][name] == case.setup.values[name] for name in known)
        head = recording.splitlines()[0].split(",")
        assert set(head) <= {"run", "t_s", "u", *(r.column for r in case.setup.readings)}


def test_the_package_reads_the_public_files(cases, tmp_path):
    """Both files are as the contract words them: the program reads them without a complaint."""
    from symplearn._simulation_file import read_simulation  # the program's own reader

    for case in cases.values():
        path = tmp_path / "simulation.toml"
        path.write_text(simulation_file(case))
        read_simulation(path)


def test_an_answer_says_all(cases, tmp_path):
    """From the answer alone the true readings come out again, and the recording's rows are read back."""
    for case in cases.values():
        document = answer(case)
        canonical(document)  # no NaN, nothing that JSON cannot hold
        setup, public = read_setup(document)
        effects = (*read_effects(document["effects"]), *read_effects(document["remainder"]))
        for again, clean in zip(clean_readings(setup, effects), document["clean"], strict=True):
            assert again == pytest.approx(np.array(clean), rel=1e-12)
        assert public.free == case.public.free
        path = tmp_path / "recording.csv"
        path.write_text(recording_file(case))
        for rows, noisy in zip(seen_rows(path, document), case.noisy, strict=True):
            assert np.array_equal(np.isnan(rows), np.isnan(noisy))
            # Written with a thousandth of the noise's sd.
            sd = np.array(list(case.setup.noise.values()))
            assert np.nanmax(np.abs(rows - noisy) / sd) < 0.01


def test_the_same_seed_draws_the_same_case(cases):
    """A case hangs on the seed and its number alone."""
    again = drawn(HEALTHY._replace(number=11), 5)
    assert canonical(answer(again)) == canonical(answer(cases["healthy 11"]))
    assert canonical(answer(drawn(HEALTHY._replace(number=11), 6))) != canonical(answer(again))


def test_the_plan_deals_every_word():
    """Of 120 cases 30 are healthy and 30 carry a remainder; every word and way comes up, each where it may."""
    items = plan(120, 0)
    assert [i.number for i in items] == list(range(1, 121))
    assert sum(i.healthy for i in items) == 30
    assert Counter(bool(i.remainder) for i in items)[True] == 30
    assert not any(i.healthy and i.remainder for i in items)
    hidden = [i for i in items if not i.healthy]
    assert {i.word for i in hidden} == {*FAMILY, "burst", "outside"}
    assert min(Counter(i.way for i in hidden).values()) >= 12 and {i.way for i in hidden} == set(WAYS)
    assert all(i.word in ALLOWED[i.way] for i in hidden)
    # A case is drawn by its number, and numbers tell nothing of what is in them.
    assert len({i.healthy for i in items[:20]}) == 2


def test_names_are_neutral():
    """A case is called by its number."""
    assert concealed.named(7) == "case_007"
