"""Where an error of the sensor stands for what is missing, larger combinations are looked for by what they explain
without it."""

from itertools import combinations
from types import SimpleNamespace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._found import Found
from symplearn.diagnosis._larger import Larger
from symplearn.diagnosis._search import Search
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 50)


def searched(evidences):
    """A search that has weighed combinations of effects: their sizes, with log evidences under white noise and beside
    an error of the sensor; and the combinations, in that order."""
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, np.cos(TIMES))], 0.05)
    found, of_size = Found(p, priors_without_effects(p)), {n: combinations(p.searched, n) for n in (1, 2)}
    some = [next(of_size[size]) for size, _, _ in evidences]
    for c, (_, *values) in zip(some, evidences, strict=True):
        for kind, value in zip(("white", "coloured"), values, strict=True):
            found.add(Estimate(c, kind, np.zeros(p.size), np.eye(p.size), np.ones(1), value, True))
    search = Search.__new__(Search)
    search.weigher = SimpleNamespace(found=found, base=(), is_many=lambda size: False)
    return search, some


@pytest.mark.parametrize(("pair", "expected"), [((50.0, 99.0), True), ((20.0, 99.0), False), ((20.0, 103.0), True)])
def test_a_pair_is_worth_a_triple(pair, expected):
    """By far better under white noise, if no likelier beside the sensor's error than an effect less; or likelier."""
    search, _ = searched([(1, 0.0, 100.0), (2, *pair)])
    assert search._gained(2) is expected


def test_the_best_under_white_noise_is_extended():
    """Of six pairs the four likeliest, and the last one, which explains most without an error of the sensor."""
    asked = []
    search, pairs = searched([*((2, 0.0, 106.0 - k) for k in range(5)), (2, 50.0, 100.0)])
    larger = Larger.__new__(Larger)
    larger.refinement = SimpleNamespace(
        found=search.found, problem=search.found.problem, weigher=search.weigher, weigh_exchanged=lambda *_: None,
        prospects=SimpleNamespace(about=lambda combination, number: asked.append(combination) or []),
    )  # fmt: skip
    assert larger.starts(3) == []
    assert asked == [*pairs[:4], pairs[5]]
