"""A candidate of every effect on the usual targets, with numbers, units and the sentence that is made of them."""

from symplearn._effects import EFFECTS, Candidate, Effect
from symplearn._vocabulary import COLUMN, COORDINATE, PAIR, PARAMETER, VOCABULARY
from symplearn.diagnosis._words import finding_sentence

TARGETS = {COORDINATE: ("theta",), PAIR: ("x", "y"), PARAMETER: ("k",), COLUMN: ("volt",)}
VALUES = {
    "c": 0.0296, "f": 0.1234, "k": 2.5, "a": 0.7, "b": 0.05, "omega": 2.0, "phi": 0.3, "j": 0.11, "t_star": 12.3,
    "r": 0.012, "d": 0.2, "kappa": 0.4, "s": 1.8, "g": 0.05, "tau": 0.02, "e": 0.03, "sd": 0.5,
}  # fmt: skip
EVERY = [(name, None) for name in VOCABULARY if name != "contact_stop"]
EVERY += [("contact_stop", "upper"), ("contact_stop", "lower")]
UNITS = {"theta": "rad", "p_theta": "J s", "x": "m", "y": "m", "p_x": "N", "p_y": "Q", "volt": "V"}
MOMENTA = {"theta": "p_theta", "x": "p_x", "y": "p_y"}


def candidate(name, side=None, targets=None):
    """An effect on the usual target of its kind."""
    word = VOCABULARY[name]
    effect = EFFECTS.get(name) or Effect(name, amplitudes=0)
    targets = targets or TARGETS[word.target]
    return Candidate(effect, targets, tuple(range(len(targets))), side)


def values(name, **changed):
    """The contract's coefficients of an effect."""
    if name == "unnamed_force":
        return {"expression": "-0.3*theta**3 - -1e-3"}
    return {c: changed.get(c, VALUES[c]) for c in VOCABULARY[name].coefficients}


def said(name, side=None, units=None, strength=None, rivals=(), only=None, **changed):
    """The sentence of a finding, with standard deviations of a twentieth."""
    estimates = {
        c: v if isinstance(v, str) else {"mean": v, "sd": abs(v) / 20, "interval95": [0.9 * v, 1.1 * v]}
        for c, v in values(name, **changed).items()
    }
    return finding_sentence(candidate(name, side), estimates, strength, units or {}, rivals, only)
