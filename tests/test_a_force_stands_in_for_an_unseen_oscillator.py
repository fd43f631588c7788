"""The push of an unseen oscillator has a line, at which a periodic force is tried in its place; so is an oscillator in
the place of a force."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._driven import _line, as_driven
from symplearn.diagnosis._prospects import MANY, Prospects
from symplearn.diagnosis._refinement import Refinement
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._start import priors_without_effects

TIMES, OMEGA, NOISE = np.linspace(0.0, 60.0, 300), 1.7, 0.01


def test_the_line_of_a_push():
    """Of a swing in closed form beside a weaker one, amplitudes and frequency within what the time tells apart."""
    push = 0.3 * np.cos(OMEGA * TIMES) - 0.4 * np.sin(OMEGA * TIMES) + 0.1 * np.cos(0.6 * TIMES)
    cosine, sine, omega = _line(push, TIMES, (0.1, 4.0))
    # Frequencies are tried a quarter of a line, 2 pi / 60, apart: half a step off at most. Over that the phase turns by
    # 0.4 at either end, which takes 3 % off the amplitude, and the weaker swing is a few per cent more.
    assert omega == pytest.approx(OMEGA, abs=2 * np.pi / 60 / 8)
    assert np.hypot(cosine, sine) == pytest.approx(0.5, rel=0.1)


def test_a_force_takes_the_place():
    """Of a spring pushed at 1.7 by DOP853, fitted with an oscillator that does not feel it: a periodic force in its
    place, from the line of its push, is at least as likely once fitted, and has the true frequency."""
    rates = lambda t, x: [x[1], -x[0] + 0.2 * np.cos(OMEGA * t)]  # noqa: E731
    path = cases.solved(rates, [1.0, 0.0], TIMES)
    readings = path[:, 0] + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}")
    p = cases.problem(file, [cases.recorded(TIMES, readings)], 0.1)
    w = cases.weigher(p, *path.T)
    members = {p.candidate(m).effect.name: m for m in p.searched if p.candidate(m).targets == ("q",)}
    hidden, force = (members["hidden_oscillator"],), (members["periodic_forcing"],)
    z = priors_without_effects(p).mean.copy()
    z[0] = 1.0
    z[p.unseen(0)] = 0.2 / 0.01, 0.0
    z[dict(p.placed(hidden))[hidden[0]]] = 0.01, OMEGA  # how strongly it is joined, and its own frequency
    w.weigh([Start(hidden, z, 0.0)], whole=True)
    (start,) = as_driven(w, hidden)
    assert start.combination == force and not start.z[p.unseen(0)].any()
    w.weigh([start], whole=True)
    one = w.found.of(force, "white")
    # Eleven standard errors of a frequency, sqrt(24 / 300) noises over amplitude and time: 0.01, 0.106 and 60.
    assert one.converged and one.z[p.slots + 2] == pytest.approx(OMEGA, abs=0.005)
    assert one.log_evidence > w.found.of(hidden, "white").log_evidence
    assert as_driven(w, force) == []


def test_an_oscillator_takes_the_place():
    """Of a spring joined to a slightly faster oscillator at rest, with which it beats (DOP853), a periodic force alone
    was fitted, since so strong a coupling promises too little about a motion that lacks it: an oscillator is tried in
    the force's place, is far likelier, and has the true frequency. In the place of a damping none is tried."""
    kappa, omega, times = 0.13, 1.06, np.linspace(0.0, 60.0, 300)
    rates = lambda t, x: [x[2], x[3], -x[0] + kappa * x[1], -(omega**2) * x[1] + kappa * x[0]]  # noqa: E731
    path = cases.solved(rates, [1.0, 0.0, 0.0, 0.0], times)
    readings = path[:, 0] + 0.04 * np.random.default_rng(1).normal(size=len(times))
    file = cases.simulation("p**2/2 + q**2/2", more="[recording.noise]\ny = 0.04")
    p = cases.problem(file, [cases.recorded(times, readings)], 0.1)
    w = cases.weigher(p, path[:, 0], path[:, 2])
    members = {p.candidate(m).effect.name: m for m in p.searched if p.candidate(m).targets == ("q",)}
    hidden, force, damping = ((members[name],) for name in ("hidden_oscillator", "periodic_forcing", "viscous_damping"))
    z = priors_without_effects(p).mean.copy()
    z[0] = 1.0
    w.weigh([Start((), z, 0.0), Start(damping, z, 0.0)], whole=True)
    prospects = Prospects(w)
    promised = {s.combination: s for s in sorted(prospects.about((), MANY), key=lambda s: s.gain)}
    w.weigh([promised[force]], whole=True)
    refinement = Refinement(prospects, lambda line: None)
    assert refinement._joined(damping) == []
    refinement.move_modes(1)
    one, other = (w.found.of(c, "white") for c in (hidden, force))
    assert one.converged and one.log_evidence > other.log_evidence + 20
    # Five of the standard deviations that the fit has of it, 0.0007. Seen: 0.0004.
    assert one.z[p.slots + 1] == pytest.approx(omega, abs=0.0035)
